"""What each task requests, and what the tasks of one instance come to: Deploy merges, Reconfigure lies over it."""
