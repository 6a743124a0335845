"""Helm charts: fetched, kept and rendered in the background."""
