"""The webhook: reviews of templates, rules and detectors over HTTPS."""
