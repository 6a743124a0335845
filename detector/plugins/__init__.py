"""Plugins: Python classes that compute a signal from the buffer. See docs/plugins.md.

This module has the interface for plugins; the rest of the package finds and runs them.
"""

from detector.engine.queries.geometry import Pose, PoseError, pose_in
from detector.engine.queries.queries import DecodedSample, Queries, QueryError
from detector.engine.queries.transforms import TransformError
from detector.plugins.base import Plugin, PluginParameters, PluginSubject, Seconds, StreamName

__all__ = [
    "DecodedSample",
    "Plugin",
    "PluginParameters",
    "PluginSubject",
    "Pose",
    "PoseError",
    "Queries",
    "QueryError",
    "Seconds",
    "StreamName",
    "TransformError",
    "pose_in",
]
