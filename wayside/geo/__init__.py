"""Positions on the earth and in local frames, and geometry over them. Pure."""
