"""Which instances should run, and which of them do if limits do not permit all."""
