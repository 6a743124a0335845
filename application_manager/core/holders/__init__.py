"""Whether those who demand, and those who manage, are still there: Leases, determined by our own clock."""
