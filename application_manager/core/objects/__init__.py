"""Turns a template and an instance into manifests: rendered, labelled, checked against the policy."""
