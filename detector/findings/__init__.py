"""The problems that a Detector detects: the findings of `check`, and losses while it runs."""
