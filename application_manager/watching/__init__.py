"""Watches, periodic lists and Leases: each event enters the cache, and the objects that it concerns are enqueued."""
