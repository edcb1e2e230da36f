"""Wheel odometry beside a path that images have shown: the scale of the path, and poses of frames that show nothing.

A body with its camera at ``lever`` moves rigidly: its displacement d and turn w, in its own axes, and the camera's
displacement c, in the camera's, are related by ``d + (exp(iw) - 1) lever = scale c``, linear in both unknowns. The
modulus of the complex scale is the height of the camera, its angle how the camera is turned on the body.
"""

import cmath
import math
from bisect import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.inputs.odometry import BodyMotion, BodyPose, motion_between
from rdstitch.numerics.robust_loss import RAYLEIGH_MEDIAN
from rdstitch.trajectories.trajectory import Trajectory, without_length

_EXACT = 1e-6  # of the longest step: no odometry is more exact, whatever it states
_WHEELS = 0.01  # relative standard deviation of what all distances share: the size of the wheels
_LEVER = 0.5  # units of the odometry: how far from the body's origin cameras are
_ROUNDS = 5  # rounds of reweighting, as wheels slip
_HUBER = 2.0  # standard deviations beyond which a step counts less
_MIN_STEPS = 3


class Motion(NamedTuple):
    """A motion of the body, and of its camera."""

    body: complex  # displacement in its own axes at the beginning, x ahead and y to the left
    camera: complex  # the same of the camera, x to the right and y to the top of the image
    turn: float  # radians, counterclockwise from above
    variance: float  # of a coordinate of the body's displacement


@dataclass(frozen=True, eq=False)
class OdometryFit:
    """How a camera is mounted on a body whose odometry is known."""

    scale: complex  # units of the odometry for one of the path; its angle is that of the camera on the body
    lever: complex  # the camera's place on the body
    noise: float  # factor of the stated standard deviations that the path shows
    covariance: NDArray[np.complex128]  # (2, 2): of scale and lever, of their real as of their imaginary parts

    @classmethod
    def of(cls, motions: Sequence[Motion]) -> "OdometryFit | None":
        """Fit motions between frames; None where they are too few, or none goes anywhere.

        With A = [camera, 1 - exp(i turn)], b = body and diagonal weights W, those of the variances times Huber's, scale
        and lever s solve the normal equations (Aᴴ W A + P) s = Aᴴ W b, where P is the prior of the lever.
        """
        if len(motions) < _MIN_STEPS:
            return None
        body, camera, turn, variance = (np.array(column) for column in zip(*motions, strict=True))
        if not np.abs(camera).sum() * np.abs(body).sum() > 0.0:
            return None
        design = np.stack([camera, 1.0 - np.exp(1j * turn)], axis=1).astype(np.complex128)
        # What images are off by does not become less where a body hardly moves.
        least = max(variance.mean(), (_EXACT * np.abs(body).max()) ** 2)
        weight, prior = 1.0 / np.maximum(variance, least), np.diag([0.0, 1.0 / _LEVER**2])
        robust_weight = np.ones(len(body))
        for _ in range(_ROUNDS):
            weighted_design = design.conj().T * (weight * robust_weight)
            normal = weighted_design @ design + prior
            solution = np.linalg.solve(normal, weighted_design @ body)
            errors = np.abs(body - design @ solution) * np.sqrt(weight)
            noise = max(float(np.median(errors)) / RAYLEIGH_MEDIAN, 1e-9)
            robust_weight = np.minimum(1.0, _HUBER * noise / np.maximum(errors, 1e-300))
        scale, lever = complex(solution[0]), complex(solution[1])
        if not abs(scale) > 0.0:
            return None
        noise = max(noise, 1.0)
        return cls(scale, lever, noise, noise**2 * np.linalg.inv(normal).astype(np.complex128))

    @property
    def length_std(self) -> float:
        """Relative standard deviation of lengths by the odometry."""
        return math.hypot(math.sqrt(self.covariance[0, 0].real) / abs(self.scale), _WHEELS)

    def moved(self, yaw: float, step: BodyMotion) -> tuple[complex, FloatArray, FloatArray]:
        """How far the camera moves from a frame of this yaw: on the plane, x to the right and y to the top.

        With the derivative (4, 4) of the new x, y (to the bottom), height and yaw by those of the frame, and the
        covariance (4, 4) that the step adds, but for the size of the wheels.
        """
        turned, heading = cmath.exp(1j * step.turn), cmath.exp(1j * yaw)
        camera = (step.moved + (turned - 1.0) * self.lever) / self.scale
        way = heading * camera
        by_fit = np.array([camera, 1.0 - turned]) / abs(self.scale)
        # What a body turns otherwise than its wheels say is a random walk: as a turn halfway, and a twelfth besides.
        bent = step.turn_variance * abs(step.moved) ** 2 / 12.0
        variance = (self.noise / abs(self.scale)) ** 2 * (step.variance + bent)
        variance += float((by_fit @ self.covariance @ by_fit.conj()).real)
        by_turn = 1j * heading * (turned * self.lever + step.moved / 2.0) / self.scale
        along_turn = np.array([by_turn.real, -by_turn.imag, 0.0, 1.0])
        added = np.diag([variance, variance, 0.0, 0.0])
        added += self.noise**2 * step.turn_variance * np.outer(along_turn, along_turn)
        carried = np.eye(4)
        carried[:2, 3] = -way.imag, -way.real
        return way, carried, added


def motions_of(poses: Sequence[tuple[complex, float, BodyPose | None]]) -> list[Motion]:
    """Motions from one frame to the next, by the place (x to the right, y to the top) and yaw of the camera."""
    motions = []
    for (place, yaw, body), (place2, yaw2, body2) in pairwise(poses):
        if body is not None and body2 is not None:
            step = motion_between(body, body2)
            moved = (place2 - place) * cmath.exp(-1j * yaw)
            motions.append(Motion(step.moved, moved, yaw2 - yaw, step.variance))
    return motions


def along_odometry(
    path: Trajectory, bodies: Mapping[int, BodyPose], *, keep_unit: bool
) -> tuple[Trajectory, OdometryFit] | None:
    """A path in the unit of the odometry, unless its own is kept, with poses of all frames that the odometry leads to.

    ``bodies``: by the number of the frame. None where it shows too few motions of the frames, or none.
    """
    places = (path.position @ np.array([1.0, -1.0j])).tolist()
    known = [bodies.get(frame) for frame in path.frame.tolist()]
    fit = OdometryFit.of(motions_of(list(zip(places, path.yaw.tolist(), known, strict=True))))
    if fit is None:
        return None
    by_images = 0.0 if math.isnan(path.length_std) else path.length_std
    if path.covariance is not None:
        path = replace(path, covariance=without_length(path.covariance, path.position, by_images))
    if not keep_unit:
        path, fit = _in_unit_of(fit, path)
    path = bridged(path, bodies, fit)
    if path.covariance is not None:
        # A height that is the unit is exact; in another unit it is as uncertain as lengths by images, besides.
        height = np.zeros(len(path)) if keep_unit else path.height
        shared = np.nan_to_num(path.length_std) * np.column_stack([path.position, height, np.zeros(len(path))])
        path.covariance[:] += shared[:, :, None] * shared[:, None]
        path.covariance[:, 2, 2] += (by_images * height) ** 2
    return path, fit


def _in_unit_of(fit: OdometryFit, path: Trajectory) -> tuple[Trajectory, OdometryFit]:
    """The path in the unit of the odometry, whose lengths it has."""
    unit, covariance = abs(fit.scale), path.covariance
    if covariance is not None:
        covariance = covariance * np.outer(change := np.array([unit, unit, unit, 1.0]), change)
    position, height = path.position * unit, path.height * unit
    scaled = replace(path, position=position, height=height, covariance=covariance, length_std=fit.length_std)
    by_unit = np.diag([1.0 / unit, 1.0])
    return scaled, replace(fit, scale=fit.scale / unit, covariance=by_unit @ fit.covariance @ by_unit)


class _Prediction(NamedTuple):
    """A pose that the odometry predicts from that of another frame."""

    place: complex
    yaw: float
    height: float
    carried: FloatArray  # carried, added: (4, 4), covariances by that of the other frame, and by the way from it
    added: FloatArray


def bridged(path: Trajectory, bodies: Mapping[int, BodyPose], fit: OdometryFit) -> Trajectory:
    """The path with the frames, of these numbers, that have no pose by images, by the odometry from those that have."""
    known = {int(frame): k for k, frame in enumerate(path.frame)}
    places = path.position @ np.array([1.0, -1.0j])
    covariances = np.zeros((len(path), 4, 4)) if path.covariance is None else path.covariance
    rows = {n: (places[k], path.yaw[k], path.height[k], covariances[k]) for n, k in known.items()}
    seen = sorted(known.keys() & bodies.keys())

    def prediction(start: int, number: int) -> _Prediction:
        k, step = known[start], motion_between(bodies[start], bodies[number])
        way, carried, added = fit.moved(path.yaw[k], step)
        covariance = carried @ covariances[k] @ carried.T
        return _Prediction(places[k] + way, path.yaw[k] + step.turn, path.height[k], covariance, added)

    for number in bodies.keys() - known.keys():
        after = bisect(seen, number)
        if ends := [*seen[:after][-1:], *seen[after : after + 1]]:
            rows[number] = _combined([prediction(end, number) for end in ends])
    frame = sorted(rows)
    at, yaw, height, covariance = zip(*(rows[number] for number in frame), strict=True)
    return replace(
        path,
        frame=np.array(frame, dtype=np.intp),
        position=np.stack([np.real(at), -np.imag(at)], axis=1),
        yaw=np.unwrap(yaw),
        height=np.array(height),
        covariance=None if path.covariance is None else np.array(covariance),
    )


def _combined(predictions: Sequence[_Prediction]) -> tuple[complex, float, float, FloatArray]:
    """Place, yaw, height and covariance (4, 4) by predictions of one frame, whose yaws differ by whole turns."""
    weights = np.array([1.0 / max(np.trace(one.added[:2, :2]), 1e-12) for one in predictions])
    weights /= weights.sum()
    yaws = np.unwrap([one.yaw for one in predictions])
    place = complex(weights @ np.array([one.place for one in predictions]))
    height = float(weights @ np.array([one.height for one in predictions]))
    best, weight = predictions[int(np.argmax(weights))], float(weights.max())
    # What lies before both ends, they share.
    return place, float(weights @ yaws), height, best.carried + weight * best.added
