"""What a Detector finds wrong: the findings of `check`, and what is lost while it runs."""
