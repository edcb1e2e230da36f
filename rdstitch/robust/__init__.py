"""Robust estimation of one pair: from matches, many of them wrong, to homography and λ.

:func:`estimate_radial_homography` is the whole of it; it reads in the order of the modules: ``sampling`` draws
minimal samples, the solvers of ``minimal`` turn them into hypotheses, ``scoring`` compares those in measured pixels,
``local_optimization`` refines the best, ``ransac`` drives the four, ``selection`` decides how free the motion was, and
``verification`` asks whether it could all be chance.
"""

from rdstitch.robust.estimate import SOLVERS, estimate_radial_homography

__all__ = ["SOLVERS", "estimate_radial_homography"]
