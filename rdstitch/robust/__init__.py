"""Homography and lens of pairs of images, from matches of which many are wrong."""

from rdstitch.choices import SOLVERS, SolverName
from rdstitch.options.estimation_options import EstimationOptions
from rdstitch.robust.estimate import PairMatches, estimate_radial_homographies, estimate_radial_homography

__all__ = [
    "SOLVERS",
    "EstimationOptions",
    "PairMatches",
    "SolverName",
    "estimate_radial_homographies",
    "estimate_radial_homography",
]
