"""What the manager tells of itself: health, metrics, traces."""
