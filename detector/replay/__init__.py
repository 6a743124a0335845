"""Recordings: written live, read from many formats, and played through the engine."""
