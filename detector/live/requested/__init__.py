"""Recordings requested over Zenoh."""

from detector.live.requested.serving import RequestedRecordings, with_requested

__all__ = ["RequestedRecordings", "with_requested"]
