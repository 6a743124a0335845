"""The network input: keys, codecs and the Zenoh session."""
