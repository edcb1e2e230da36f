"""Three points, rotation about the centre, unknown focal length: λ and the focal length from two angles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.solvers.batch import IndexArray, SampleArrays, solve_in_blocks
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.rays import RayPairs, turned_solutions
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_DEGREE = 18

Coefficients = Sequence[FloatArray]


def rotation_three_point(
    x1: ArrayLike,
    x2: ArrayLike,
    distortion_range: tuple[float, float] = (-0.95, 0.5),
    focal_range: tuple[float, float] = (0.2, 20.0),
) -> Solutions:
    """Rotation about the camera's centre, λ and the focal length from three points (Byröd, Brown and Åström 2009).

    The angles between three rays ``r = (x, g (1 + λ |x|²))`` are kept. For fixed λ each of them is a cubic in g²,

    ``(d + g² z)² (ĉ + g² ê) = (d̂ + g² ẑ)² (c + g² e)``,

    with ``d = x_1 · x_2``, ``c = (x_1 × x_2)²`` constant and ``z = z_1 z_2``, ``e = |z_2 x_1 - z_1 x_2|²`` of degree 2
    in λ, so that the coefficient of ``g^2k`` has degree 2k. Two angles have a common g² where the resultant of their
    cubics is zero: the determinant of Bézout's 3 x 3 matrix, a polynomial of degree 18 in λ. The matrix's kernel there
    is ``(1, g², g⁴)``. The third angle is left to the data; the least-squares rotation of the three rays gives the
    rest.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 3, 2) or (3, 2)
        Normalized points of image 1 and image 2, in any unit around the distortion centre.
    distortion_range : (float, float)
        Range of λ to search, in the frame of the points.
    focal_range : (float, float)
        Range of the focal length, in the unit of the points.

    Returns
    -------
    Solutions
        Every real λ in the range with a focal length in its range, for which all points are within the lens model;
        with focal lengths.

    Raises
    ------
    ArgumentError
        When a shape is wrong or a range is empty.
    """
    low, high = focal_range
    if not 0.0 < low < high:
        raise ArgumentError(f"focal range must be (low, high) with 0 < low < high, not {focal_range}")

    def solve(points: FloatArray, _: IndexArray) -> Solutions:
        pairs = RayPairs.between(points[:, :, [0, 0]], points[:, :, 1:])
        equation = Resultant(pairs)
        index, distortion = real_roots(equation, _DEGREE, *lens_range(points, distortion_range))
        pairs = pairs.take(index)
        focal2 = polished(pairs, distortion, common_root(*cubics(pairs, distortion)))
        possible = (focal2 > low * low) & (focal2 < high * high) & pairs.same_side(distortion, focal2)
        index, distortion, focal2 = index[possible], distortion[possible], focal2[possible]
        return turned_solutions(np.take(points, index, axis=-1), index, distortion, np.sqrt(focal2), _rotation_of_many)

    return solve_in_blocks(solve, x1, x2, 3)


@dataclass(frozen=True)
class Resultant(SampleArrays):
    """The equation of :func:`rotation_three_point`."""

    pairs: RayPairs

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """Determinant of Bézout's matrix of the two cubics."""
        (a, b, c), (_, d, e), (_, _, f) = bezout(*cubics(self.pairs, distortion))
        value: FloatArray = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
        return value


def cubics(pairs: RayPairs, distortion: FloatArray) -> tuple[Coefficients, Coefficients]:
    """Coefficients of 1, g², g⁴, g⁶ in the equations of two pairs, for λ of shape (..., b).

    Each has the shape of λ, or one that broadcasts to it.
    """
    product, length = pairs.products(distortion)
    shape = (*pairs.dot.shape[:2], *[1] * (distortion.ndim - 1), pairs.dot.shape[-1])
    d, c = pairs.dot.reshape(shape), pairs.cross.reshape(shape)

    def side(i: int, j: int) -> list[FloatArray]:
        """``(d + g² z)²`` of image i times ``c + g² e`` of image j."""
        return [
            d[i] * d[i] * c[j],
            d[i] * (2.0 * product[i] * c[j] + d[i] * length[j]),
            product[i] * (product[i] * c[j] + 2.0 * d[i] * length[j]),
            product[i] * product[i] * length[j],
        ]

    differences = [left - right for left, right in zip(side(0, 1), side(1, 0), strict=True)]
    return [difference[0] for difference in differences], [difference[1] for difference in differences]


def bezout(f: Coefficients, g: Coefficients) -> tuple[tuple[FloatArray, FloatArray, FloatArray], ...]:
    """Bézout's symmetric 3 x 3 matrix of two cubics with four coefficients each, constant first."""

    def minor(i: int, j: int) -> FloatArray:
        return np.asarray(f[i] * g[j] - f[j] * g[i])

    first = minor(1, 0), minor(2, 0), minor(3, 0)
    middle = minor(2, 1) + first[2]
    return (first[0], first[1], first[2]), (first[1], middle, minor(3, 1)), (first[2], minor(3, 1), minor(3, 2))


def common_root(f: Coefficients, g: Coefficients) -> FloatArray:
    """The root (b,) that two cubics share where their resultant is zero.

    The kernel of Bézout's matrix is ``(1, t, t²)``; it is any row of the adjugate, of which the largest is exact.
    """
    rows = np.array(bezout(f, g))
    adjugate = np.stack(
        [np.cross(rows[1], rows[2], axis=0), np.cross(rows[2], rows[0], axis=0), np.cross(rows[0], rows[1], axis=0)]
    )
    largest = np.argmax(np.abs(adjugate).max(axis=1), axis=0)
    kernel = np.take_along_axis(adjugate, largest[None, None], axis=0)[0]
    return np.asarray(np.where(np.abs(kernel[0]) >= np.abs(kernel[2]), kernel[1] / kernel[0], kernel[2] / kernel[1]))


def polished(pairs: RayPairs, distortion: FloatArray, focal2: FloatArray) -> FloatArray:
    """g² after a step of Newton's method on the sum of the squares of both equations, for given λ."""
    f = np.array(cubics(pairs, distortion))
    value = f[:, 0] + focal2 * (f[:, 1] + focal2 * (f[:, 2] + focal2 * f[:, 3]))
    slope = f[:, 1] + focal2 * (2.0 * f[:, 2] + focal2 * 3.0 * f[:, 3])
    step = (value * slope).sum(axis=0) / (slope * slope).sum(axis=0)
    return np.where(np.abs(step) < 0.01 * np.abs(focal2), focal2 - step, focal2)


def _rotation_of_many(bundle: FloatArray) -> FloatArray:
    """The least-squares rotations (b, 3, 3) of unit rays (3, 2, k, b), by Kabsch's singular value decomposition."""
    correlation = np.einsum("ikb,jkb->bij", bundle[:, 1], bundle[:, 0])
    left, _, right = np.linalg.svd(correlation)
    left[..., 2] *= np.where(np.linalg.det(left @ right) < 0.0, -1.0, 1.0)[:, None]
    rotation: FloatArray = left @ right
    return rotation
