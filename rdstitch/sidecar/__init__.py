"""The sidecar: everything estimated, as JSON beside the image."""
