"""Commands that read or print, and end by themselves."""
