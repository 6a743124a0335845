"""Health, metrics and traces of the manager."""
