"""The API server: reached, read, written, and who of several managers may write."""
