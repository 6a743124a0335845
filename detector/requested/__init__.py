"""Recordings requested over Zenoh."""

from detector.requested.running import with_requested
from detector.requested.serving import Requested

__all__ = ["Requested", "with_requested"]
