"""Time axes: a Detector has one, by its clock."""

from __future__ import annotations

from detector.engine.timing.data import DataTimeline
from detector.engine.timing.wall import WallTimeline

Timeline = WallTimeline | DataTimeline

ORDER = 2
"""The order of time that an engine keeps. It is the `version` of an intake file, which so replays as it was recorded.

A file that names no version has order 1. There, with clock Data and a lateness of zero, a tick runs with the first
stamp of its time; with clock Wall, what came during a stall is evaluated at its own time, after the gap. And `distance`
and `closingSpeed` are those of then, to the last digit; the second of `closingSpeed` ends now, however old places are.
"""
