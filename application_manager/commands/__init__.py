"""The command line, and the commands that read or print, and end by themselves."""
