"""Mining: the same replay over many recordings, by many processes, into one dataset."""
