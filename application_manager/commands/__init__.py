"""The command line, and the commands that only read or print."""
