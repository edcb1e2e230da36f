"""Three points, tilt unknown: the minimal case, by Newton's method from several starts."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.division_model import SOLVED_DISTORTION
from rdstitch.solvers.batch import IndexArray, SampleArrays, solve_in_blocks
from rdstitch.solvers.lines import Lines, mirrored, oriented_samples, squared_radii, triangle_determinants
from rdstitch.solvers.plane import TiltRotations, lens_range, motion_homography
from rdstitch.solvers.solutions import Solutions

RealArray = NDArray[np.floating[Any]]

DEFAULT_STARTS: FloatArray = np.array(
    [
        (0.0, 0.0, -0.35),
        (-0.2, 0.1, -0.1),
        (0.2, -0.1, -0.35),
        (0.2, 0.45, -0.35),
        (-0.3, -0.45, -0.35),
        (0.45, -0.45, -0.1),
        (-0.3, 0.45, -0.35),
        (0.3, 0.1, -0.35),
        (0.0, -0.2, -0.35),
    ]
)
"""Starts (a, b, λ) that complement each other: chosen one by one for the solutions that the earlier ones miss."""

_ROUGH_STEPS = 5
_STEPS = 10
_MAX_STEP = 0.4
# Newton's method squares the error: after a step this short there is only rounding error left.
_CONVERGED = 1e-8
_MERGED = 1e-2  # distance of states (a, b, λ) after the rough steps below which they are one
_SAME = 1e-6
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
# A plane seen at more than 63 degrees from the vertical is given up.
_MAX_TILT_TANGENT = 2.0
_STATES_IN_BLOCK = 9216


def three_point(
    x1: ArrayLike,
    x2: ArrayLike,
    distortion_range: tuple[float, float] = SOLVED_DISTORTION,
    starts: ArrayLike = DEFAULT_STARTS,
) -> Solutions:
    """Planar motion with unknown tilt, and λ, from three points: as many equations as unknowns.

    A rigid motion keeps all three distances. With the plane normal ``n ~ (a, b, 1)``, depths ``w_i = n · p_i(λ)`` and
    ``p_i w_j - p_j w_i = n × (p_i × p_j)``, these are three equations in (a, b, λ):

    ``log |n × (p_i × p_j)| - log w_i w_j`` is the same in both images.

    Newton's method on the logarithms, with steps limited in length, runs from all starts of all samples at once. It
    finds the solutions that the starts lead to, not provably all: from the default starts the true one in about 99 %
    of noise-free samples with tilts up to 0.3 radians, and in 96 % up to 0.6.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 3, 2) or (3, 2)
        Focal-normalized points of image 1 and image 2.
    distortion_range : (float, float)
        Range of λ (focal-normalized) to search.
    starts : array_like of shape (S, 3)
        Rows (a, b, λ), ``a = n_x / n_z``, ``b = n_y / n_z``. A good guess of tilt and λ is a better start than the
        default ones.

    Returns
    -------
    Solutions
        Those for which all points are in front of the camera and within the lens model, λ is in the range and the
        triangle is not mirrored.
    """
    first = np.asarray(starts, dtype=np.float64)
    if first.ndim != 2 or first.shape[1] != 3 or not len(first) or not np.isfinite(first).all():
        raise ArgumentError(f"starts must be rows (a, b, lambda) of finite numbers, not shape {first.shape}")

    def solve(points: FloatArray, _: IndexArray) -> Solutions:
        opposite = Lines.opposite(points)
        triangles = triangle_determinants(points, opposite)
        usable, low, high = oriented_samples(triangles, *lens_range(points, distortion_range))
        system = DistanceSystem.of(np.take(points, usable, axis=-1), opposite.take(usable))
        index, state = newton(system, first)
        inside = (state[2] > low[index]) & (state[2] < high[index])
        index, state = usable[index[inside]], state[:, inside]
        points = np.take(points, index, axis=-1)
        possible = np.flatnonzero(_in_front(points, state) & ~mirrored(np.take(triangles, index, axis=-1), state[2]))
        (a, b, distortion), index = state[:, possible], index[possible]
        normal = np.stack([a, b, np.ones_like(a)]) / np.sqrt(a * a + b * b + 1.0)
        h = motion_homography(np.take(points, possible, axis=-1), TiltRotations.from_normal(normal), distortion)
        return Solutions(index, h, distortion)

    return solve_in_blocks(solve, x1, x2, 3, block_size=max(1, _STATES_IN_BLOCK // len(first)))


def _in_front(points: FloatArray, state: FloatArray) -> BoolArray:
    """Test that all points (2, 2, 3, b) are in front of the camera of each state (a, b, λ)."""
    a, b, distortion = state
    depth = 1.0 + a * points[0] + b * points[1] + distortion * squared_radii(points)
    return np.asarray((depth > 0.0).all(axis=(0, 1)))


@dataclass(frozen=True, eq=False)
class DistanceSystem(SampleArrays):
    """The three equations of :func:`three_point`."""

    # (8, 2, 3, b): x, y, r² of each point, then constants of the three coordinates of the line opposite to it, and
    # slopes of the first two; image, point, sample
    rows: RealArray

    @classmethod
    def of(cls, points: FloatArray, opposite: Lines) -> "DistanceSystem":
        """Set up the equations of points (2, 2, 3, b)."""
        return cls(np.concatenate([points, squared_radii(points)[None], opposite.constant, opposite.slope]))

    def step(self, state: RealArray) -> RealArray:
        """Newton's step from the states (a, b, λ), shape (3, B)."""
        a, b, lam = state
        x, y, r2, c1, c2, c3, s1, s2 = self.rows
        w = 1.0 + a * x + b * y + lam * r2
        c1, c2 = c1 + lam * s1, c2 + lam * s2
        m1, m2, m3 = b * c3 - c2, c1 - a * c3, a * c2 - b * c1
        size = m1**2 + m2**2 + m3**2
        pair = w[:, _NEXT] * w[:, _LAST]
        first, second = size[0] * pair[1] ** 2, size[1] * pair[0] ** 2
        # Up to third order half the difference of the logarithms of the squared distances; unlike that it is bounded,
        # which keeps early steps short, and needs no logarithm.
        value = (first - second) / (first + second)
        per_size, per_depth = 1.0 / size, 1.0 / w
        by_a = _between((m3 * c2 - m2 * c3) * per_size, x * per_depth)
        by_b = _between((m1 * c3 - m3 * c1) * per_size, y * per_depth)
        by_lam = _between((m2 * s1 - m1 * s2 + m3 * (a * s2 - b * s1)) * per_size, r2 * per_depth)
        return _solve_3x3(by_a, by_b, by_lam, -value)


def _between(length: RealArray, depth: RealArray) -> RealArray:
    """Difference between the images of ``length - (sum of depth over the pair)``, from (2, 3, B) to (3, B)."""
    difference: RealArray = depth[0] - depth[1]
    # The sum over a pair is the sum over all three points less the opposite one.
    difference -= difference.sum(axis=0)
    difference += length[0] - length[1]
    return difference


def _solve_3x3(a: RealArray, b: RealArray, c: RealArray, right: RealArray) -> RealArray:
    """Solve ``[a b c] s = right`` for columns of shape (3, B), by Cramer's rule."""
    normal = _cross(b, c)
    determinant = (a * normal).sum(axis=0)
    across = _cross(right, a)
    solved = np.stack([(right * normal).sum(axis=0), -(c * across).sum(axis=0), (b * across).sum(axis=0)])
    return np.asarray(solved / determinant)


def _cross(a: RealArray, b: RealArray) -> RealArray:
    """Cross product of vectors of shape (3, B)."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def newton(system: DistanceSystem, starts: FloatArray) -> tuple[IndexArray, FloatArray]:
    """Different solutions that Newton's method reaches from every start of every sample.

    The sample of each (M,), ascending, and the states (3, M): a, b and λ. The first steps need no accuracy and run in
    single precision. By then most starts of a sample have met; those that have go on as one.
    """
    count = system.rows.shape[-1]
    single = DistanceSystem(np.tile(system.rows.astype(np.float32), len(starts)))
    rough = np.repeat(starts.T.astype(np.float32), count, axis=1)
    for _ in range(_ROUGH_STEPS):
        step = single.step(rough)
        rough += step * np.minimum(np.float32(1.0), np.float32(_MAX_STEP) / np.abs(step).max(axis=0))
    origin = np.flatnonzero(_leaders(rough.reshape(3, len(starts), count)))
    state = rough[:, origin].astype(np.float64)
    origin %= count
    system = system.take(origin)

    samples, states = [origin[:0]], [state[:, :0]]
    for _ in range(_STEPS):
        step = system.step(state)
        length = np.abs(step).max(axis=0)
        state = state + step * np.minimum(1.0, _MAX_STEP / length)
        done = length < _CONVERGED
        going = (length >= _CONVERGED) & _visible(state)
        samples.append(origin[done])
        states.append(state[:, done])
        if not going.any():
            break
        index = np.flatnonzero(going)
        origin, state, system = origin[index], state[:, index], system.take(index)
    return _different(np.concatenate(samples), np.concatenate(states, axis=1))


def _leaders(state: RealArray) -> BoolArray:
    """Select the first of the states (3, S, B) of each sample that have met, unless it is impossible; (S B,)."""
    leads = _visible(state)
    for later in range(1, state.shape[1]):
        distance = np.abs(state[:, :later] - state[:, later, None]).max(axis=0)
        leads[later] &= ~(distance < _MERGED).any(axis=0)
    return leads.ravel()


def _visible(state: RealArray) -> BoolArray:
    """Whether a camera of each state (a, b, λ), (3, ...), is not tilted too far."""
    return np.asarray(np.abs(state[:2]).max(axis=0) < _MAX_TILT_TANGENT)


def _different(sample: IndexArray, state: FloatArray) -> tuple[IndexArray, FloatArray]:
    """One of each group of equal states of the same sample."""
    order = np.lexsort((state[2], sample))
    sample, state = sample[order], state[:, order]
    new = np.ones(len(sample), dtype=np.bool_)
    new[1:] = (np.diff(sample) > 0) | (np.abs(np.diff(state, axis=1)).max(axis=0) > _SAME)
    return sample[new], state[:, new]
