"""Samples, signals and conditions in columns: whole blocks of points (tick, subject) at a time."""
