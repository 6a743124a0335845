"""Sources of samples other than Zenoh: what a plugin is made of, and how plugins are found and run.

A package offers a source as an entry point of the group `wayside.sources`; see docs/sources.md.
"""

from detector.sources.base import Feed, Source, SourceError

__all__ = ["Feed", "Source", "SourceError"]
