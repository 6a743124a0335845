"""Recordings requested over Zenoh."""

from detector.live.requested.serving import Requested, with_requested

__all__ = ["Requested", "with_requested"]
