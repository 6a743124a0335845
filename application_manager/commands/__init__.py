"""Commands that look or print, and end by themselves."""
