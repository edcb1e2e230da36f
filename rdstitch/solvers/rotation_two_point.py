"""Two points, rotation about the centre, known focal length: λ from the one angle between them."""

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.geometry.division_model import SOLVED_DISTORTION
from rdstitch.solvers.batch import IndexArray, solve_in_blocks
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.rays import RayPairs, rotation_of_two, turned_solutions
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_DEGREE = 6


def rotation_two_point(
    x1: ArrayLike, x2: ArrayLike, distortion_range: tuple[float, float] = SOLVED_DISTORTION
) -> Solutions:
    """Rotation about the camera's centre and λ from two points, for a known focal length.

    With focal-normalized points the rays are ``r = (x, 1 + λ |x|²)``. A rotation keeps the angle between two of them,

    ``(r_1 · r_2)² |r̂_1 × r̂_2|² = (r̂_1 · r̂_2)² |r_1 × r_2|²``,

    where dot products and squared cross products have degree 2 in λ (:mod:`rdstitch.solvers.rays`): a polynomial of
    degree 6. The rotation that turns bisector and plane of the rays into each other gives the rest.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 2, 2) or (2, 2)
        Focal-normalized points of image 1 and image 2.
    distortion_range : (float, float)
        Range of λ (focal-normalized) to search.

    Returns
    -------
    Solutions
        Every real λ in the range for which all points are within the lens model; homographies are rotations.
    """

    def solve(points: FloatArray, _: IndexArray) -> Solutions:
        pairs = RayPairs.between(points[:, :, :1], points[:, :, 1:])
        index, distortion = real_roots(pairs, _DEGREE, *lens_range(points, distortion_range))
        possible = pairs.take(index).same_side(distortion, np.ones_like(distortion))
        index, distortion = index[possible], distortion[possible]
        points = np.take(points, index, axis=-1)
        return turned_solutions(points, index, distortion, np.ones_like(distortion), rotation_of_two)

    return solve_in_blocks(solve, x1, x2, 2)
