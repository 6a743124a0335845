"""Errors of recordings."""

import struct

from wayside.inputerror import InputError


class RecordingError(InputError, ValueError):
    """A recording that cannot be read or does not fit the Detector; the text names the place and the remedy."""


DAMAGE = (
    AssertionError,
    LookupError,
    MemoryError,
    OSError,
    OverflowError,
    RuntimeError,  # what lz4 raises
    TypeError,
    ValueError,
    struct.error,
)
"""Exceptions of parsers of binary files for unexpected bytes, beside their own. Caught only around the reading of a
file, in which any byte may be damaged."""
