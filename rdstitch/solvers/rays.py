"""Rays of a camera that turns on the spot, and the rotation between two bundles of them.

Inside a solver the points of both images have shape (2, 2, k, b): coordinate, image, point, sample. With the lens
gone a measured point is the ray ``r = (x, g z)``, ``z = 1 + λ |x|²`` and g the focal length. A rotation keeps the
angles between rays, so that their tangents agree:

``(r_1 · r_2)² |r̂_1 × r̂_2|² = (r̂_1 · r̂_2)² |r_1 × r_2|²``,

with ``r_1 · r_2 = x_1 · x_2 + g² z_1 z_2`` and ``|r_1 × r_2|² = (x_1 × x_2)² + g² |z_2 x_1 - z_1 x_2|²``. Both are
linear in g², and for a known focal length of degree 2 in λ.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.solvers.batch import IndexArray, SampleArrays
from rdstitch.solvers.lines import squared_radii
from rdstitch.solvers.solutions import Solutions


@dataclass(frozen=True, eq=False)
class RayPairs(SampleArrays):
    """Pairs of rays, P of them in each sample."""

    dot: FloatArray  # dot, cross: (2, P, b): ``x_1 · x_2`` and ``(x_1 × x_2)²``; image, pair, sample
    cross: FloatArray
    depth: FloatArray  # (2, 2, P, b): ``|x|²`` of the first and the second point: the slopes of their ``z``
    # (2, 2, 2, P, b): constants and slopes in λ of ``z_2 x_1 - z_1 x_2``; constant or slope, coordinate
    across: FloatArray

    @classmethod
    def between(cls, first: FloatArray, second: FloatArray) -> "RayPairs":
        """Pair the rays of points (2, 2, P, b) each."""
        (xa, ya), (xb, yb) = first, second
        ra, rb = squared_radii(first), squared_radii(second)
        turn = xa * yb - ya * xb
        across = np.stack([first - second, np.stack([rb * xa - ra * xb, rb * ya - ra * yb])])
        return cls(xa * xb + ya * yb, turn * turn, np.stack([ra, rb]), across)

    def products(self, distortion: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``z_1 z_2`` and ``|z_2 x_1 - z_1 x_2|²`` for λ of shape (..., b); shape (2, P, ..., b) each."""
        depth, across = (_spread(values, distortion) for values in (self.depth, self.across))
        x, y = across[0] + across[1] * distortion
        first, second = 1.0 + depth * distortion
        return first * second, x * x + y * y

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The difference of both sides of the equation of the first pair for g = 1, of degree 6 in λ (..., b)."""
        product, length = self.products(distortion)
        dot, cross = (_spread(self.dot, distortion) + product)[:, 0], (_spread(self.cross, distortion) + length)[:, 0]
        return np.asarray(dot[0] * dot[0] * cross[1] - dot[1] * dot[1] * cross[0])

    def same_side(self, distortion: FloatArray, focal2: FloatArray) -> BoolArray:
        """Test that all angles, (b,), are acute or obtuse in both images alike, which squared tangents hide."""
        dot = self.dot + focal2 * self.products(distortion)[0]
        return np.asarray((dot[0] * dot[1] > 0.0).all(axis=0))


def _spread(values: FloatArray, distortion: FloatArray) -> FloatArray:
    """Values (..., b) that broadcast against λ of shape (..., b)."""
    return values.reshape(*values.shape[:-1], *[1] * (distortion.ndim - 1), values.shape[-1])


def rotation_of_two(bundle: FloatArray) -> FloatArray:
    """Rotations (b, 3, 3) that turn the rays of image 1 to those of image 2 best, for unit rays (3, 2, 2, b).

    For two rays the least-squares rotation (Kabsch) turns their bisector and their plane into each other.
    """
    first, second = bundle[:, :, 0], bundle[:, :, 1]
    along, across = _unit(first + second), _unit(first - second)
    normal = np.cross(along, across, axis=0)
    frames = np.stack([along, across, normal], axis=1)
    return np.asarray(np.einsum("ikb,jkb->bij", frames[:, :, 1], frames[:, :, 0]))


def turned_solutions(
    points: FloatArray,
    sample: IndexArray,
    distortion: FloatArray,
    focal: FloatArray,
    rotate: Callable[[FloatArray], FloatArray],
) -> Solutions:
    """Solutions from λ and focal lengths (b,) of points (2, 2, k, b); those that leave a point behind are left out."""
    bundle = _unit(np.concatenate([points, (focal * (1.0 + distortion * squared_radii(points)))[None]]))
    rotation = rotate(bundle)
    # In front of the camera of image 2, whatever the errors of a sample that no rotation fits.
    ahead = np.einsum("bj,jkb->kb", rotation[:, 2], bundle[:, 0])
    kept = np.flatnonzero((ahead > 0.0).all(axis=0) & np.isfinite(rotation).all(axis=(1, 2)))
    k = np.stack([focal, focal, np.ones_like(focal)], axis=-1)[kept]
    homography = rotation[kept] * (k[:, :, None] / k[:, None, :])  # K R K⁻¹ with K = diag(g, g, 1)
    return Solutions(sample[kept], homography, distortion[kept], focal[kept])


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.sqrt((vectors * vectors).sum(axis=0)))
