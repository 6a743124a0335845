"""What is in a recording: topics with their rates and fields, and streams that would take them."""
