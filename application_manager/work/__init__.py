"""Reconciling: a queue of keys for each kind, and the work on one key."""
