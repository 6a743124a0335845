"""The record action: the samples of an episode's window become a rosbag2 folder with MCAP files.

`action` has a `recording` for each open episode. Its `folder` is hidden until it is complete, its disk space comes from
the `destination` that all rules share, and its samples go through an `mcap_file`. `recovery` completes the recordings
of a killed process. `description` and `channels` describe recordings.
"""

from detector.actions.record.action import Record

__all__ = ["Record"]
