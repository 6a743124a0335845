"""The input: samples and tokens, and the one place where they get their receive time."""
