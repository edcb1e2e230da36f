"""Wheel odometry beside a path that images have shown: the scale of the path, and poses of frames that show nothing.

A body with its camera at ``lever`` moves rigidly: its displacement d and turn w, in its own axes, and the camera's
displacement c, in the camera's, are related by ``d + (exp(iw) - 1) lever = scale c``, linear in both unknowns. The
modulus of the complex scale is the height of the camera, its angle how the camera is turned on the body.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rdstitch.alignment.trajectory import Trajectory
from rdstitch.arrays import FloatArray
from rdstitch.inputs.odometry import BodyPose, motion_between

_EXACT = 1e-6  # of the longest step: no odometry is more exact, whatever it states
_WHEELS = 0.01  # relative standard deviation of what all distances share: the size of the wheels
_LEVER = 0.5  # units of the odometry: how far from the body's origin cameras are
_ROUNDS, _HUBER = 5, 2.0  # wheels slip
_MIN_STEPS = 3


class Motion(NamedTuple):
    """A motion of the body, and of its camera."""

    body: complex  # displacement in its own axes at the beginning, x ahead and y to the left
    camera: complex  # the same of the camera, x to the right and y to the top of the image
    turn: float  # radians, counterclockwise from above
    variance: float  # of a coordinate of the body's displacement


@dataclass(frozen=True)
class OdometryFit:
    """How a camera is mounted on a body whose odometry is known."""

    scale: complex  # units of the odometry for one of the path; its angle is that of the camera on the body
    lever: complex  # the camera's place on the body
    noise: float  # factor of the stated standard deviations that the path shows
    relative_std: float  # of the scale

    @classmethod
    def of(cls, motions: Sequence[Motion]) -> "OdometryFit | None":
        """From motions between frames; None where they are too few, or none goes anywhere."""
        if len(motions) < _MIN_STEPS:
            return None
        body, camera, turn, variance = (np.array(column) for column in zip(*motions, strict=True))
        if not np.abs(camera).sum() * np.abs(body).sum() > 0.0:
            return None
        design = np.stack([camera, 1.0 - np.exp(1j * turn)], axis=1).astype(np.complex128)
        # What images are off by does not become less where a body hardly moves.
        least = max(variance.mean(), (_EXACT * np.abs(body).max()) ** 2)
        weight, prior = 1.0 / np.maximum(variance, least), np.diag([0.0, 1.0 / _LEVER**2])
        rest = np.ones(len(body))
        for _ in range(_ROUNDS):
            by = design.conj().T * (weight * rest)
            normal = by @ design + prior
            solution = np.linalg.solve(normal, by @ body)
            errors = np.abs(body - design @ solution) * np.sqrt(weight)
            noise = max(float(np.median(errors)) / math.sqrt(math.log(2.0)), 1e-9)
            rest = np.minimum(1.0, _HUBER * noise / np.maximum(errors, 1e-300))
        scale, lever = complex(solution[0]), complex(solution[1])
        if not abs(scale) > 0.0:
            return None
        deviation = math.sqrt(float(np.linalg.inv(normal)[0, 0].real) / 2.0) * max(noise, 1.0)
        return cls(scale, lever, max(noise, 1.0), math.hypot(deviation / abs(scale), _WHEELS))

    def camera_motion(self, body: complex, turn: float) -> complex:
        """How far the camera moves, in its own axes and in units of the path."""
        return (body + (cmath.exp(1j * turn) - 1.0) * self.lever) / self.scale


def motions_of(poses: Sequence[tuple[complex, float, BodyPose | None]]) -> list[Motion]:
    """Motions from one frame to the next, by the place (x to the right, y to the top) and yaw of the camera."""
    motions = []
    for (place, yaw, body), (place2, yaw2, body2) in pairwise(poses):
        if body is not None and body2 is not None:
            step = motion_between(body, body2)
            moved = (place2 - place) * cmath.exp(-1j * yaw)
            motions.append(Motion(step.moved, moved, yaw2 - yaw, step.variance))
    return motions


def scaled_by_odometry(
    path: Trajectory, bodies: Sequence[BodyPose | None], *, keep_unit: bool
) -> tuple[Trajectory, OdometryFit] | None:
    """A path in the unit of the odometry, by that of each frame, and how they are related; None where they are not."""
    places = (path.position @ np.array([1.0, -1.0j])).tolist()
    fit = OdometryFit.of(motions_of(list(zip(places, path.yaw.tolist(), bodies, strict=True))))
    if fit is None:
        return None
    if keep_unit:
        return path, fit
    unit = abs(fit.scale)
    covariance = path.covariance
    if covariance is not None:
        change = np.diag([unit, unit, unit, 1.0])
        known = zip(change @ covariance @ change, unit * path.position, strict=True)
        covariance = np.array([_with_length(one, place, fit.relative_std) for one, place in known])
    scaled = replace(path, position=path.position * unit, height=path.height * unit, covariance=covariance)
    return scaled, replace(fit, scale=fit.scale / unit)


def _with_length(covariance: FloatArray, place: FloatArray, relative_std: float) -> FloatArray:
    """The covariance (4, 4) of a pose whose distance from the first one is also known relatively so well."""
    far = float(np.hypot(*place))
    along = np.zeros(4)
    along[:2] = place / max(far, 1e-300)
    moved = covariance @ along
    spread = float(along @ moved)
    known = (relative_std * far) ** 2
    return covariance if spread <= known else covariance - np.outer(moved, moved) * (1.0 - known / spread) / spread


class _Prediction(NamedTuple):
    """A pose that the odometry predicts from that of another frame."""

    place: complex
    yaw: float
    height: float
    variance: float  # of a coordinate of the place
    yaw_variance: float
    row: int  # of the other frame in the path


def bridged(path: Trajectory, bodies: Mapping[int, BodyPose], fit: OdometryFit) -> Trajectory:
    """The path with the frames, of these numbers, that have no pose by images, by the odometry from those that have."""
    known = {int(frame): k for k, frame in enumerate(path.frame)}
    places = path.position @ np.array([1.0, -1.0j])
    covariances = np.zeros((len(path), 4, 4)) if path.covariance is None else path.covariance
    rows = {n: (places[k], path.yaw[k], path.height[k], covariances[k]) for n, k in known.items()}
    seen = sorted(known.keys() & bodies.keys())

    def prediction(start: int, number: int) -> _Prediction:
        k, step = known[start], motion_between(bodies[start], bodies[number])
        place = places[k] + cmath.exp(1j * path.yaw[k]) * fit.camera_motion(step.moved, step.turn)
        yaw_variance = fit.noise**2 * step.turn_variance
        variance = fit.noise**2 * step.variance + yaw_variance * abs(step.moved) ** 2
        return _Prediction(place, path.yaw[k] + step.turn, path.height[k], variance, yaw_variance, k)

    for number in bodies.keys() - known.keys():
        ends = [*[n for n in seen if n < number][-1:], *[n for n in seen if n > number][:1]]
        if ends:
            rows[number] = _combined([prediction(end, number) for end in ends], covariances)
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


def _combined(predictions: Sequence[_Prediction], covariances: FloatArray) -> tuple[complex, float, float, FloatArray]:
    """Place, yaw, height and covariance (4, 4) by predictions of one frame, whose yaws differ by whole turns."""
    weights = np.array([1.0 / max(one.variance, 1e-12) for one in predictions])
    weights /= weights.sum()
    yaws = np.unwrap([one.yaw for one in predictions])
    place = complex(weights @ np.array([one.place for one in predictions]))
    height = float(weights @ np.array([one.height for one in predictions]))
    best, weight = predictions[int(np.argmax(weights))], float(weights.max())
    own = weight * np.diag([best.variance, best.variance, 0.0, best.yaw_variance])
    return place, float(weights @ yaws), height, covariances[best.row] + own
