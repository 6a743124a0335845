"""Whether holders of demands are alive, by their Leases and the manager's own clock."""
