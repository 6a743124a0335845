"""Whether what was applied does its work, and in words what keeps it from that."""
