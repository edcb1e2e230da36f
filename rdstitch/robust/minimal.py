"""Minimal solvers as RANSAC sees them: a sample size and a function, all in the half-diagonal frame."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from rdstitch import solvers
from rdstitch.arrays import FloatArray
from rdstitch.robust.pair_models import HomographyModel, PairModel, PlanarModel, Tilts
from rdstitch.solvers.solutions import Solutions

Solve = Callable[[FloatArray, FloatArray], Solutions]

DISTORTION_RANGE = (-0.95, 0.5)
"""λ in the half-diagonal frame that is searched: from nearly folding barrel to strong pincushion distortion."""

_LEVEL: Tilts = ((0.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True)
class MinimalSolver:
    """A minimal solver.

    Attributes
    ----------
    name : str
        As the user names it.
    sample_size : int
    solve : callable
        Maps points (B, sample_size, 2) of both pictures, in the half-diagonal frame, to solutions in that frame.
    model : PairModel
        The model that the solver assumes; its solutions are refined with it first.
    fixed_distortion : bool
        Whether λ is known.
    """

    name: str
    sample_size: int
    solve: Solve
    model: PairModel
    fixed_distortion: bool = False


def minimal_solvers(
    focal: float, focal_std: float, tilts: Tilts | None, distortion: float | None
) -> list[MinimalSolver]:
    """The solvers that the known quantities allow, those with the fewest points first.

    Parameters
    ----------
    focal : float
        Focal length in half diagonals.
    focal_std : float
        Standard deviation of its logarithm.
    tilts : pair of (float, float) or None
        Known tilts (ψ, θ) of both pictures, radians.
    distortion : float or None
        Known λ in the half-diagonal frame.
    """
    rigid = PlanarModel(focal, focal_std, tilts)
    similarity = PlanarModel(focal, focal_std, tilts, height_free=True)
    assumed = tilts or _LEVEL
    if distortion is not None:
        known = distortion * focal**2
        points2 = partial(solvers.two_point_similarity, distortion=known, tilt=assumed)
        dlt = partial(solvers.four_point_dlt, distortion=distortion)
        return [
            MinimalSolver("two_point_similarity", 2, _in_focal_lengths(points2, focal), similarity, True),
            MinimalSolver("four_point_dlt", 4, dlt, HomographyModel(), True),
        ]
    low, high = DISTORTION_RANGE
    searched = {"distortion_range": (low * focal**2, high * focal**2)}
    if tilts is None:
        planar = MinimalSolver(
            "three_point", 3, _in_focal_lengths(partial(solvers.three_point, **searched), focal), rigid
        )
    else:
        two_point = partial(solvers.two_point, tilt=tilts, **searched)
        planar = MinimalSolver("two_point", 2, _in_focal_lengths(two_point, focal), rigid)
    scaled = partial(solvers.three_point_similarity, tilt=assumed, **searched)
    four_point = _in_focal_lengths(partial(solvers.four_point, **searched), focal)
    five_point = partial(solvers.five_point, distortion_range=DISTORTION_RANGE)
    return [
        planar,
        MinimalSolver("three_point_similarity", 3, _in_focal_lengths(scaled, focal), similarity),
        MinimalSolver("four_point", 4, four_point, rigid),
        MinimalSolver("five_point", 5, five_point, HomographyModel()),
    ]


def _in_focal_lengths(solve: Solve, focal: float) -> Solve:
    """A solver that sees focal-normalized points, as one for points in half diagonals.

    With ``x_f = x / focal``: ``λ = λ_f / focal²`` and ``H = K H_f K⁻¹``, ``K = diag(focal, focal, 1)``.
    """
    k = np.array([focal, focal, 1.0])

    def solve_in_half_diagonals(x1: FloatArray, x2: FloatArray) -> Solutions:
        found = solve(x1 / focal, x2 / focal)
        return Solutions(found.sample, found.homography * (k[:, None] / k), found.distortion / focal**2)

    return solve_in_half_diagonals
