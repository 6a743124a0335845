"""What a running detector reports about itself: its status, the same as metrics, and the requests that it answers."""
