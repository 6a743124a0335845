"""The demand and the statuses: pure functions of the live objects. No I/O, no clock."""
