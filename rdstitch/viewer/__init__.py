"""A page to look at a Deep Zoom image."""
