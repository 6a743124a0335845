"""What should run, and what is to be said about it: pure functions of what is live. No I/O, no clock reading."""
