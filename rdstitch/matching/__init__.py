"""Candidate pairs, their matches, and two-view geometry; static backgrounds and mixed lenses."""
