"""Whether those who demand, and those who manage, are still there: Leases, judged by our own clock."""
