"""The stages of a registration: features, pairs, alignment, and the checks after which images are left out."""
