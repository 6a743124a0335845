"""Time: the time axis, the ticks, and which subjects are evaluated when."""
