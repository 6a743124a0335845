"""The cache of the cluster, with its indexes, in memory."""
