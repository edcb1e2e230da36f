"""Minimal solvers as RANSAC sees them: a sample size and a function, all in the half-diagonal frame."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from rdstitch import solvers
from rdstitch.arrays import FloatArray
from rdstitch.geometry.division_model import SEARCHED_DISTORTION
from rdstitch.robust.pair_models import HomographyPairModel, PairModel, PlanarPairModel
from rdstitch.robust.priors import Prior
from rdstitch.solvers.solutions import Solutions

# half-diagonal frame: so near to any lens up to a wide angle that some inliers agree
_SAMPLED_DISTORTION = (0.0, -0.12, -0.3)

Solve = Callable[[FloatArray, FloatArray, FloatArray | None], Solutions]


@dataclass(frozen=True, eq=False)
class MinimalSolver:
    """A minimal solver."""

    name: str  # as RadialHomography.solver reports it
    sample_size: int
    # maps points (B, sample_size, 2) of both images, in the half-diagonal frame, and the known tilts (B, 2, 2) of both
    # images of each sample, radians, or None, to solutions in that frame
    solve: Solve
    model: PairModel  # the model that the solver assumes, in which solutions with few inliers are refined
    fixed_distortion: bool = False  # whether λ is known


@lru_cache(maxsize=64)
def minimal_solvers(
    focal: float, focal_prior: Prior, tilts_known: bool, distortion: float | None
) -> tuple[MinimalSolver, ...]:
    """The solvers that the known quantities allow, those with the fewest points first.

    ``focal``: focal length in half diagonals; ``focal_prior``: on its logarithm; ``tilts_known``: whether the tilts of
    both images are known; ``distortion``: known λ in the half-diagonal frame.
    """
    rigid = PlanarPairModel(focal, focal_prior, tilts_known)
    similarity = PlanarPairModel(focal, focal_prior, tilts_known, height_free=True)
    if distortion is not None:
        known = distortion * focal**2
        points2 = partial(solvers.two_point_similarity, distortion=known)
        dlt = partial(solvers.four_point_dlt, distortion=distortion)
        turn = partial(solvers.rotation_two_point_focal, distortion=distortion)
        return (
            MinimalSolver("rotation_two_point_focal", 2, _scaled(turn), HomographyPairModel(), True),
            MinimalSolver("two_point_similarity", 2, _scaled(points2, focal, tilted=True), similarity, True),
            MinimalSolver("four_point_dlt", 4, _scaled(dlt), HomographyPairModel(), True),
        )
    low, high = SEARCHED_DISTORTION
    searched = {"distortion_range": (low * focal**2, high * focal**2)}
    if tilts_known:
        planar = MinimalSolver(
            "two_point", 2, _scaled(partial(solvers.two_point, **searched), focal, tilted=True), rigid
        )
    else:
        planar = MinimalSolver("three_point", 3, _scaled(partial(solvers.three_point, **searched), focal), rigid)
    changing = partial(solvers.three_point_similarity, **searched)
    four_point = partial(solvers.four_point, **searched)
    five_point = partial(solvers.five_point, distortion_range=SEARCHED_DISTORTION)
    turn = partial(solvers.rotation_two_point, **searched)
    return (
        # A camera that turns: two points find pairs of a tenth of inliers three times as often as five do, whatever the
        # focal length is taken for.
        MinimalSolver("rotation_two_point", 2, _scaled(turn, focal), HomographyPairModel()),
        planar,
        MinimalSolver("three_point_similarity", 3, _scaled(changing, focal, tilted=True), similarity),
        MinimalSolver("four_point", 4, _scaled(four_point, focal), rigid),
        MinimalSolver("five_point", 5, _scaled(five_point), HomographyPairModel()),
        MinimalSolver("four_point_dlt", 4, _scaled(_sampled_distortion), HomographyPairModel()),
    )


def _sampled_distortion(x1: FloatArray, x2: FloatArray) -> Solutions:
    """Homographies by four points for each of a few λ (Tzamos et al. 2024); local optimization then frees λ.

    One point less finds pairs with a tenth of inliers twice as often.
    """
    count = len(_SAMPLED_DISTORTION)
    solutions = solvers.four_point_dlt(
        np.repeat(x1, count, axis=0), np.repeat(x2, count, axis=0), np.tile(_SAMPLED_DISTORTION, len(x1))
    )
    return Solutions(solutions.sample // count, solutions.homography, solutions.distortion)


def _scaled(solve: Callable[..., Solutions], focal: float = 1.0, *, tilted: bool = False) -> Solve:
    """A solver of focal-normalized points as one of points in half diagonals.

    With ``x_f = x / focal``: ``λ = λ_f / focal²`` and ``H = K H_f K⁻¹``, ``K = diag(focal, focal, 1)``. ``tilted``:
    it takes tilts; without any, the camera is taken to be level.
    """
    k = np.array([focal, focal, 1.0])

    def solve_in_half_diagonals(x1: FloatArray, x2: FloatArray, tilts: FloatArray | None = None) -> Solutions:
        known = {"tilt": (0.0, 0.0) if tilts is None else tilts} if tilted else {}
        solutions = solve(x1 / focal, x2 / focal, **known)
        return Solutions(solutions.sample, solutions.homography * (k[:, None] / k), solutions.distortion / focal**2)

    return solve_in_half_diagonals
