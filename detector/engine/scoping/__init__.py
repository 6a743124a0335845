"""Whom a rule is evaluated for, and what its expressions see of each subject."""
