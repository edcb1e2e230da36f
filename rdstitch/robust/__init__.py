"""Robust estimation of pairs: from matches, many of them wrong, to homography and λ, for many pairs in lockstep.

:func:`estimate_radial_homography` is the whole of it for one pair; it reads in the order of the modules: ``sampling``
draws minimal samples, the solvers of ``minimal`` turn them into hypotheses, ``scoring`` compares those in measured
pixels, ``refinement`` improves the best by the ``levenberg_marquardt`` of the loss in ``linearization``, ``ransac``
drives the four, ``model_selection`` decides how free the motion was, and ``verification`` whether it could all be
chance.
"""

from rdstitch.robust.estimate import (
    SOLVERS,
    EstimationOptions,
    PairMatches,
    SolverName,
    estimate_radial_homographies,
    estimate_radial_homography,
)
from rdstitch.robust.ransac import RansacOptions

__all__ = [
    "SOLVERS",
    "EstimationOptions",
    "PairMatches",
    "RansacOptions",
    "SolverName",
    "estimate_radial_homographies",
    "estimate_radial_homography",
]
