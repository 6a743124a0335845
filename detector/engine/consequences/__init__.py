"""What actions are told: episodes that start and end, and the samples around them."""
