"""Minimal solvers that the library does not use: a baseline, and one for a camera whose focal length is not known."""
