"""Where the Detector and its EventRules come from: files, or the API server, whose changes are followed."""
