"""The samples of the last seconds: which client sent them, where they are stored, and how they are read."""
