"""Images in and out, with their metadata, and nothing half-written."""
