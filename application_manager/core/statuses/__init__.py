"""What is said: statuses, Events and explanations."""
