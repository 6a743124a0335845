"""The topics of a recording with their rates and fields, and proposals of streams for them."""
