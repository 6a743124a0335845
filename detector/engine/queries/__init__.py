"""The queries of plugins to the buffer: samples, poses, tuples and transforms, up to the tick."""
