"""Rules at their ticks: their inputs, which of them are evaluated together, and the episodes that start and end."""
