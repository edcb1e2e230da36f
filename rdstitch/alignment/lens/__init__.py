"""Which lens the images show, and what is said of it."""
