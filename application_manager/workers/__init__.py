"""Evaluates users' expressions in at most two worker processes, with a limit of CPU time."""
