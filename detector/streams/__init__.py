"""Where the data comes from: keys, codecs and the Zenoh session."""
