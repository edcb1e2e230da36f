"""What is upright in a scene: vanishing points of straight edges, rectangles, and the rotations that they stand for.

A panorama is turned by a rotation of its directions, a plane by the homography of a camera in the place of the
reference image that looks elsewhere. Both follow from two directions in the axes of the reference image's camera (to
the right, down, ahead): those that shall be horizontal and vertical in the output.

Points ``x`` of the reference image are undistorted, homogeneous, in half diagonals from the centre; with f, the focal
length in half diagonals, ``diag(1, 1, f) x`` is the direction in those axes. Lines are ``l`` with ``l · x = 0``.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.planar_motion import nearest_rotation, rotation_about
from rdstitch.robust.chance import binomial_tail

_TOLERANCE = math.radians(1.0)  # between an edge and the line from its middle to its vanishing point
_CROOKED = math.radians(0.2)  # standard deviation of edges that should be parallel, besides that of their ends
_HYPOTHESES = 500
_MAX_EDGES = 500
_MAX_STEPS = 50
_FALSE_ALARMS = 1e-3  # that may be expected in a scene without parallel edges
_UNKNOWN_FOCAL = 0.1  # standard deviation of log f, from which on several focal lengths are tried
_FOCAL_STEPS = np.linspace(-2.0, 2.0, 5)  # standard deviations


@dataclass(frozen=True)
class Focal:
    """A focal length in half diagonals, and the standard deviation of its logarithm; 0 where it is fixed."""

    value: float
    log_std: float = 0.0

    def combined(self, log_focal: float, log_std: float) -> "Focal":
        """Combine it with another estimate."""
        if not self.log_std:
            return self
        weights = np.array([self.log_std, log_std]) ** -2.0
        mean = float(weights @ [math.log(self.value), log_focal] / weights.sum())
        return Focal(math.exp(mean), float(weights.sum() ** -0.5))


@dataclass(frozen=True, eq=False)
class Upright:
    """Directions (2, 3) that shall be horizontal and vertical, in the axes of the reference image's camera."""

    axes: FloatArray
    focal: Focal

    def matrix(self, frame: FloatArray, *, turned: bool) -> FloatArray:
        """What takes the images to the output.

        ``frame`` (3, 3) leads from ``x`` of the reference image to the plane, or to directions where the camera
        ``turned``.
        """
        basis = np.column_stack([*self.axes, np.cross(*self.axes)])
        if turned:
            basis = nearest_rotation(basis)
        return np.linalg.inv(basis) @ to_axes(frame, self.focal.value)


def to_axes(frame: FloatArray, focal: float) -> FloatArray:
    """Matrix from plane or directions to directions in the axes of the reference image's camera, with determinant 1."""
    matrix = np.diag([1.0, 1.0, focal]) @ np.linalg.inv(frame)
    return np.asarray(matrix / np.cbrt(np.linalg.det(matrix)))


def of_rectangle(corners: FloatArray, focal: Focal, pixel: float) -> tuple[Upright, float, float]:
    """Compute the upright from the corners of a rectangle in space, as Zhang and He (2007) do.

    ``corners`` (4, 2) are ``x``, clockwise; ``pixel`` is one in half diagonals. The focal length is the one by
    which the sides are also orthogonal; then come the aspect ratio, width by height, and its relative standard
    deviation where corners are a pixel off.
    """
    sides = _sides(corners)
    if sides is None or np.cross(sides[0], sides[1])[2] <= 0.0:
        raise ArgumentError("rectangle: give the corners of a convex quadrilateral, clockwise from the top left one")
    # What changes with each coordinate, one pixel off.
    moved = [_sides(corners + pixel * step.reshape(4, 2)) or sides for step in np.eye(8)]
    if (value := _log_focal(sides)) is not None:
        others = [_log_focal(other) for other in moved]
        std = math.sqrt(sum(math.inf if other is None else (other - value) ** 2 for other in others))
        if 0.0 < std < math.inf:
            focal = focal.combined(value, std)
    low, aspect, high = (_aspect(sides, focal.value * math.exp(k * focal.log_std)) for k in (-1.0, 0.0, 1.0))
    error = math.hypot((high - low) / 2.0, *(_aspect(other, focal.value) - aspect for other in moved)) / aspect
    axes = np.array(sides) * (1.0, 1.0, focal.value)
    upright = Upright(axes / np.linalg.norm(axes, axis=1, keepdims=True), focal)
    return upright, aspect, error


def _sides(corners: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """The sides of a parallelogram in space, to the right and down, in ``x``; None where the corners show none."""
    points = np.column_stack([corners, np.ones(4)])
    depth = np.linalg.svd((points * [[1.0], [-1.0], [1.0], [-1.0]]).T)[2][3]
    depth *= np.sign(depth.sum())
    if not (depth > 1e-9).all():
        return None
    places = points * depth[:, None]
    return places[1] - places[0], places[3] - places[0]


def _log_focal(sides: tuple[FloatArray, FloatArray]) -> float | None:
    """Logarithm of the focal length for which the sides are orthogonal; None where there is none."""
    flat, deep = float(sides[0][:2] @ sides[1][:2]), float(sides[0][2] * sides[1][2])
    return 0.5 * math.log(-flat / deep) if flat * deep < 0.0 else None


def _aspect(sides: tuple[FloatArray, FloatArray], focal: float) -> float:
    across, down = (float(np.linalg.norm(side * (1.0, 1.0, focal))) for side in sides)
    return across / down


@dataclass(frozen=True, eq=False)
class Edges:
    """Straight edges, to which directions in the axes of the reference image's camera are parallel or not."""

    # (N, 3): ``l``, of which the first two are of length 1; on the sphere, the normals of planes through the camera
    lines: FloatArray
    middles: FloatArray  # (N, 3): ``x`` with 1 as third coordinate; on the sphere, directions of length 1
    error: FloatArray  # (N,): standard deviation of the angle of each, radians
    # whether lines are those of directions, for which the focal length is 1, and angles those between planes
    on_sphere: bool = False

    @classmethod
    def between(cls, ends: FloatArray, error: float, *, on_sphere: bool = False) -> Self:
        """Lines between their ends (N, 2, 3), ``x`` or directions, and the standard deviation of these."""
        ends = ends / (np.linalg.norm(ends, axis=2, keepdims=True) if on_sphere else ends[:, :, 2:])
        lines, middles = np.cross(ends[:, 0], ends[:, 1]), ends.sum(axis=1)
        lengths = np.linalg.norm(lines if on_sphere else lines[:, :2], axis=1)
        middles /= np.linalg.norm(middles, axis=1, keepdims=True) if on_sphere else middles[:, 2:]
        angle = np.hypot(math.sqrt(2.0) * error / lengths, _CROOKED)
        return cls(lines / lengths[:, None], middles, angle, on_sphere)

    def chosen(self, which: BoolArray | IntArray) -> Self:
        """Some of them."""
        return replace(self, lines=self.lines[which], middles=self.middles[which], error=self.error[which])

    def normals(self, focal: float) -> FloatArray:
        """Normals (N, 3) of the planes through the edges and the camera."""
        return self.lines * (focal, focal, 1.0)

    def distances(self, directions: FloatArray, focal: float) -> tuple[FloatArray, FloatArray]:
        """Distances (..., N) from middles to vanishing points of directions (..., N or 1, 3), and their gradients."""
        middles = self.middles
        if self.on_sphere:
            along = (directions * middles).sum(axis=-1)
            distance = np.sqrt(np.maximum(1.0 - along**2, 1e-12))
            return distance, -along[..., None] * middles / distance[..., None]
        away = focal * directions[..., :2] - directions[..., 2:] * middles[:, :2]
        distance = np.maximum(np.linalg.norm(away, axis=-1), 1e-6)
        away /= distance[..., None]
        return distance, np.concatenate([focal * away, -(away * middles[:, :2]).sum(axis=-1, keepdims=True)], axis=-1)

    def angles(self, directions: FloatArray, focal: float) -> FloatArray:
        """Angles (..., N), radians, between edges and the lines from their middles to directions (..., 3)."""
        off = np.abs(directions @ self.normals(focal).T) / self.distances(directions[..., None, :], focal)[0]
        return np.asarray(np.arcsin(np.minimum(off, 1.0)))


def of_edges(edges: Edges, axis: IntArray, start: FloatArray, focal: Focal, first_focal: float) -> Upright:
    """The least rotation by which edges become horizontal and vertical, as least squares have it.

    ``axis`` (N,) is 0 for edges that shall be horizontal, 1 for vertical ones, 2 for those that lead straight away;
    ``start`` (3, 3) are directions to the right, down and ahead.
    """
    axes, log_focal = start, math.log(first_focal)
    for _ in range(_MAX_STEPS):
        value, wanted = math.exp(log_focal), axes[axis]
        normals, (distance, gradient) = edges.normals(value), edges.distances(wanted, value)
        off = (normals * wanted).sum(axis=1) / distance
        change = (normals - off[:, None] * gradient) / (distance * edges.error)[:, None]  # by the direction
        by_focal = (change[:, :2] * wanted[:, :2]).sum(axis=1, keepdims=True)
        prior = 1.0 / (focal.log_std or 1.0)
        jacobian = np.hstack([np.cross(wanted, change), by_focal if focal.log_std else 0.0 * by_focal])
        jacobian = np.vstack([jacobian, [0.0, 0.0, 0.0, prior]])
        residual = np.append(off / edges.error, prior * (log_focal - math.log(focal.value)))
        step = np.linalg.lstsq(jacobian, -residual, rcond=1e-9)[0]
        axes, log_focal = axes @ rotation_about(step[:3]).T, log_focal + float(np.clip(step[3], -0.3, 0.3))
        if np.abs(step).max() < 1e-12:
            break
    return Upright(axes[:2], Focal(math.exp(log_focal), focal.log_std))


def nearest_axis(edges: Edges, axes: FloatArray, focal: float) -> IntArray:
    """The axis, of directions (K, 3), that each edge is nearest to, (N,)."""
    return np.asarray(np.argmin(edges.angles(axes, focal), axis=0), dtype=np.intp)


def of_scene(edges: Edges, start: FloatArray, focal: Focal, *, depth: bool) -> tuple[Upright, int, int] | None:
    """The directions that most edges are parallel to: a vanishing point near the vertical, and one at right angles.

    Random pairs of edges give a direction, a third one the other (RANSAC). A direction counts if so many edges would
    not lead to one point by chance, as a contrario methods have it (Almansa, Desolneux and Vamech 2003). ``start`` (3,
    3) are directions to the right, down and ahead of the output without it; none is farther than 45 degrees from its
    own. ``depth`` says whether edges lead away, besides those of a plane. Then come the numbers of edges that are
    horizontal and vertical by it; None where no direction counts.
    """
    edges = edges.chosen(np.argsort(edges.error, kind="stable")[:_MAX_EDGES])
    tried = []
    for step in _FOCAL_STEPS if focal.log_std > _UNKNOWN_FOCAL else (0.0,):
        value = focal.value * math.exp(step * focal.log_std)
        axes, score = _best_axes(edges, start, value, depth=depth)
        tried.append((score - step**2 / 2.0, -abs(step), value, axes))
    _, _, value, axes = max(tried, key=lambda one: one[:2])
    angles = edges.angles(axes if depth else axes[:2], value)
    axis, fitting = np.argmin(angles, axis=0), angles.min(axis=0, initial=np.inf) < _TOLERANCE
    meaningful = [k for k in range(len(angles)) if _false_alarms(axis == k, fitting) < _FALSE_ALARMS]
    if not {0, 1} & set(meaningful):
        return None
    kept = fitting & np.isin(axis, meaningful)
    upright = of_edges(edges.chosen(kept), axis[kept], axes if len(meaningful) > 1 else start, focal, value)
    return upright, int((axis[kept] == 0).sum()), int((axis[kept] == 1).sum())


def _false_alarms(of_axis: BoolArray, fitting: BoolArray) -> float:
    """Directions by pairs of edges that would be expected to fit as many edges by chance.

    Edges come in pairs, one on each side of a line; only half of them count.
    """
    count, fit = int(of_axis.sum()) // 2, int((of_axis & fitting).sum()) // 2
    return float(count**2 / 2.0 * binomial_tail(fit, count, _TOLERANCE / (np.pi / 4))) if fit else math.inf


def _best_axes(edges: Edges, start: FloatArray, focal: float, *, depth: bool) -> tuple[FloatArray, float]:
    """Orthogonal directions (3, 3) that most edges are parallel to, at least to the first two, and their score."""
    rng = np.random.default_rng(0)
    normals = edges.normals(focal)
    near = nearest_axis(edges, start[:2], focal)
    frames = [start[None]]
    for first, second in ((1, 0), (0, 1)):
        parallel, others = np.flatnonzero(near == first), np.flatnonzero(near == second)
        if len(parallel) < 2:
            continue
        pairs = rng.choice(parallel, (2, _HYPOTHESES))
        directions = _along(np.cross(normals[pairs[0]], normals[pairs[1]]), start[first])
        if len(others):
            across = np.cross(normals[rng.choice(others, _HYPOTHESES)], directions)
        else:
            across = start[second] - (directions @ start[second])[:, None] * directions
        both = [_along(across, start[second]), directions]
        right, down = both if first == 1 else both[::-1]
        frames.append(np.stack([right, down, np.cross(right, down)], axis=1))
    axes = np.concatenate(frames)
    axes = axes[((axes * start)[:, :2].sum(axis=2) > math.cos(np.pi / 4)).all(axis=1)]
    angles = edges.angles(axes if depth else axes[:, :2], focal).min(axis=1) / _TOLERANCE
    scores = np.maximum(1.0 - angles**2, 0.0) @ np.minimum(_CROOKED / edges.error, 0.5)
    best = int(np.argmax(scores))
    return axes[best], float(scores[best])


def _along(directions: FloatArray, wanted: FloatArray) -> FloatArray:
    """Directions (N, 3) with length 1 and the sign by which they are nearer to ``wanted``."""
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(directions / np.maximum(length, 1e-12) * np.where(directions @ wanted < 0.0, -1.0, 1.0)[:, None])
