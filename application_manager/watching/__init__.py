"""Watches, periodic lists and Leases: each event enters the cache, and what it concerns is enqueued."""
