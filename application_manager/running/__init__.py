"""The running manager: its options, start, wiring of queues to work, and stop."""
