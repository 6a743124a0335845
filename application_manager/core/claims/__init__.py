"""What each task requests, and the merged result of the tasks of one instance."""
