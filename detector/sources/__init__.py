"""Sources of samples other than Zenoh: the plugin interface, and how plugins are found and run.

A package provides a source as an entry point of the group `wayside.sources`; see docs/sources.md.
"""

from detector.sources.base import Feed, Source, SourceError

__all__ = ["Feed", "Source", "SourceError"]
