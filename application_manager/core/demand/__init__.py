"""The demanded instances, and which of them run if limits do not permit all."""
