"""What should run, and the statuses that follow: pure functions of the live objects. No I/O, no clock."""
