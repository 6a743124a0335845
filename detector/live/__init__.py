"""The running detector: its evaluator, its outlets, what it answers, and how it starts, resumes and stops."""
