"""What actions receive: the start and end of episodes, and the samples around them."""
