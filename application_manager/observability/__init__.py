"""Health and metrics of the manager."""
