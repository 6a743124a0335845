"""What is done when something changed: a queue of keys for each kind, and the reconciling of one key."""
