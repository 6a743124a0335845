"""The status of a running detector, the same as metrics, and the requests that it handles."""
