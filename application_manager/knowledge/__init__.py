"""What the manager knows of the cluster, with its indexes, in memory."""
