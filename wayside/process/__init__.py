"""The shared parts of both programs' processes: start, command line, certificate, traces and backoff."""
