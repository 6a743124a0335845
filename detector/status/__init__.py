"""What a running detector says of itself: its status, the same as metrics, and the requests that it answers."""
