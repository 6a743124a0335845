"""What can be wrong with a recording."""


class RecordingError(ValueError):
    """A recording that cannot be read or does not fit the Detector; the text names the place and the remedy."""
