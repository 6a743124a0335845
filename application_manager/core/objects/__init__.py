"""From a template and an instance to manifests: rendered, labelled, allowed."""
