"""The API server's questions about templates, rules and detectors, answered over HTTPS."""
