"""Helm charts: fetched, cached and rendered in the background."""
