"""Finds errors in templates, rules and Detectors before anything depends on them."""
