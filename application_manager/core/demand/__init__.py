"""What should run, and where not all can, who does."""
