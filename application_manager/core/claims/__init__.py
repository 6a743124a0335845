"""The claims of tasks, and their merged result for one instance."""
