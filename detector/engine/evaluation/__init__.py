"""Rules at their ticks: what they look at, which are evaluated together, and the episodes that start and end."""
