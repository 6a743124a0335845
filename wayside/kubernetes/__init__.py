"""Access to the API server, as both programs need it: errors, retries, and a queue of keys to reconcile. Does I/O."""
