"""Recordings that others ask for over Zenoh."""

from detector.requested.asking import Requested
from detector.requested.running import with_requested

__all__ = ["Requested", "with_requested"]
