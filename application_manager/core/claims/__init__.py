"""What each task asks for, and what the tasks of one instance come to: Deploy merges, Reconfigure lies over it."""
