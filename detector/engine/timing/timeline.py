"""Time axes: a Detector has one, depending on its clock."""

from __future__ import annotations

from detector.engine.timing.data import DataTimeline
from detector.engine.timing.wall import WallTimeline

Timeline = WallTimeline | DataTimeline

ORDER = 2
"""The time-order version of an engine. It is the `version` of an intake file, so that the file replays as it was
recorded.

A file without a version has order 1. There, with clock Data and a lateness of zero, a tick runs with the first stamp of
its time; with clock Wall, samples received during a stall are evaluated at their own times, after the gap. `distance`
and `closingSpeed` have the values of that version, to the last digit; the second of `closingSpeed` ends now, however
old places are.
"""
