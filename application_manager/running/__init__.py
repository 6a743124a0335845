"""A manager that runs: its options, start, wiring of queues to work, and end."""
