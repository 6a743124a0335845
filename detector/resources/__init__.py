"""The sources of the Detector and its EventRules: files, or the API server, which is watched for changes."""
