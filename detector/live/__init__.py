"""The running detector: its evaluator, its outlets, its responses to requests, and how it starts, resumes and stops."""
