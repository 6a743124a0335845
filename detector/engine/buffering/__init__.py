"""The samples of the last seconds: whose they are, where they are kept, and how they are read."""
