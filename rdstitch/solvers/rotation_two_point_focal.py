"""Two points, rotation about the centre, known λ: the focal length from the one angle between them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.solvers.batch import IndexArray, SampleArrays, solve_in_blocks
from rdstitch.solvers.known_distortion import distortions
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.rays import RayPairs, rotation_of_two, turned_solutions
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_DEGREE = 3


def rotation_two_point_focal(
    x1: ArrayLike, x2: ArrayLike, distortion: ArrayLike, focal_range: tuple[float, float] = (0.2, 20.0)
) -> Solutions:
    """Rotation about the camera's centre and the focal length from two points, for known λ.

    The angle between the rays ``r = (x, g (1 + λ |x|²))`` is kept: a cubic in g² (:mod:`rdstitch.solvers.rays`). It is
    solved for ``t = g² / (1 + g²)``, in which the long focal lengths lie no farther apart than the short ones.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 2, 2) or (2, 2)
        Normalized points of image 1 and image 2, in any unit around the distortion centre.
    distortion : array_like of shape () or (B,)
        λ in the frame of the points.
    focal_range : (float, float)
        Range of the focal length, in the unit of the points.

    Returns
    -------
    Solutions
        Every focal length in the range; none where a point is outside the lens model, or points coincide.
    """
    low, high = focal_range
    if not 0.0 < low < high:
        raise ArgumentError(f"focal range must be (low, high) with 0 < low < high, not {focal_range}")
    known = distortions(distortion, x1)

    def solve(points: FloatArray, samples: IndexArray) -> Solutions:
        lam = known[samples]
        least, most = lens_range(points, (-np.inf, np.inf))
        inside = np.flatnonzero((lam > least) & (lam < most))
        points, lam = np.take(points, inside, axis=-1), lam[inside]
        pairs = RayPairs.between(points[:, :, :1], points[:, :, 1:])
        ends = (np.full(len(lam), f * f / (1.0 + f * f)) for f in (low, high))
        index, t = real_roots(_AngleEquation(*pairs.products(lam), pairs.dot, pairs.cross), _DEGREE, *ends)
        focal2 = t / (1.0 - t)
        possible = pairs.take(index).same_side(lam[index], focal2)
        index, focal2 = index[possible], focal2[possible]
        points = np.take(points, index, axis=-1)
        return turned_solutions(points, inside[index], lam[index], np.sqrt(focal2), rotation_of_two)

    return solve_in_blocks(solve, x1, x2, 2)


@dataclass(frozen=True, eq=False)
class _AngleEquation(SampleArrays):
    """The equation of :func:`rotation_two_point_focal`, homogeneous in (1 - t, t)."""

    # product, length, dot, cross: (2, 1, b): as in :class:`rdstitch.solvers.rays.RayPairs`; image, pair, sample
    product: FloatArray
    length: FloatArray
    dot: FloatArray
    cross: FloatArray

    def polynomial(self, t: FloatArray) -> FloatArray:
        """The equation itself."""
        dot = [(1.0 - t) * self.dot[k, 0] + t * self.product[k, 0] for k in (0, 1)]
        cross = [(1.0 - t) * self.cross[k, 0] + t * self.length[k, 0] for k in (0, 1)]
        return np.asarray(dot[0] * dot[0] * cross[1] - dot[1] * dot[1] * cross[0])
