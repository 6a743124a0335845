"""What is wrong with templates, rules and detectors, before anything depends on them."""
