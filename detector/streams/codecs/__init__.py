"""Codecs: from the bytes of a message to plain maps, lists, strings and doubles."""
