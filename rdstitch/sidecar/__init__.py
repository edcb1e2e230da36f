"""The sidecar: everything estimated, as JSON beside the picture."""
