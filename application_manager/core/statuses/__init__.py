"""Statuses, Events and explanations."""
