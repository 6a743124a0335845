"""The detector's access to the Kubernetes API: one connection, typed errors, and lists that are kept current."""
