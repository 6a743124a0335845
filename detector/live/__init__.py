"""The running detector: its evaluator, event sink and responses to requests, and how it starts, resumes and stops."""
