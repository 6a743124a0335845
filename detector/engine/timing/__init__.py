"""When something happens: the time axis, the ticks, and who is looked at when."""
