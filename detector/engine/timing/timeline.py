"""Time axes: a Detector has one, by its clock."""

from __future__ import annotations

from detector.engine.timing.data import DataTimeline
from detector.engine.timing.wall import WallTimeline

Timeline = WallTimeline | DataTimeline
