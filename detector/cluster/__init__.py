"""The Kubernetes API as the detector uses it: one connection, typed errors, and lists that are kept current."""
