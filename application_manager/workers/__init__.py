"""Where users' expressions run: in at most two processes beside the manager's, with a limit of CPU time."""
