"""Reports: statuses, Events and explanations."""
