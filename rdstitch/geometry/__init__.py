"""The nouns of the field: camera, lens, homography, coordinate systems."""
