"""Positions on the Earth and in local frames, and geometry over them. Pure."""
