"""A generated intersection, and rules of everyday field work over it."""
