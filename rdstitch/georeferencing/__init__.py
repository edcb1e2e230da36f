"""Where a mosaic lies on the Earth: by positions of its images, by control points, or on the grid of a map."""
