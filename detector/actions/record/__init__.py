"""The record action: the samples of an episode's window become a rosbag2 folder with MCAP files.

`action` keeps a `recording` for each open episode; its `folder` is hidden until it is whole, its room comes from the
`destination` that all rules share, and its samples go through an `mcap_file`. What a killed process leaves behind,
`recovery` completes. `description`, `channels` and `bag` describe recordings.
"""

from detector.actions.record.action import Record

__all__ = ["Record"]
