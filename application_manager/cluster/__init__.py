"""The API server: connection, reads, writes, and leader election."""
