"""Recordings requested over Zenoh."""

from detector.live.requested.running import with_requested
from detector.live.requested.serving import Requested

__all__ = ["Requested", "with_requested"]
