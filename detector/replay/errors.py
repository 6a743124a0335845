"""What can be wrong with a recording."""

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
"""What parsers of binary files raise, beside errors of their own, where the bytes are not what they expect. Caught only
around their reading of a file, each byte of which may be damaged."""
