"""Whether the applied objects are ready, and the reason if they are not."""
