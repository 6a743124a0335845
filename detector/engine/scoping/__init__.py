"""The subjects that a rule is evaluated for, and the variables of its expressions for each subject."""
