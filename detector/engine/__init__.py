"""The engine: synchronous and deterministic. Samples and a clock go in, events come out. No I/O, no clock reading."""
