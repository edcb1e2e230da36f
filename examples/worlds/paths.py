"""Poses along a robot's paths and of a drone's survey; see :mod:`rdstitch.synthetic.poses`."""

import numpy as np
from numpy.typing import NDArray

from rdstitch.synthetic import Lens, Poses
from rdstitch.synthetic.lenses import focal_length
from rdstitch.synthetic.poses import Tilt, extent_of

_PARKING_ANGLE = 0.7  # radians: how far a robot is turned in the middle of the S


def drive_poses(
    lens: Lens,
    path: str,
    count: int,
    *,
    overlap: float = 0.8,
    heading: float = 0.0,
    tilt: Tilt = (0.0, 0.0),
) -> Poses:
    """A robot, to which the camera is fixed, drives a path of the paper (§5.5).

    ``path`` is "line"; "turn": on, through a right angle, and on; or "parking": past the gap, back into it in an S, and
    up. Consecutive images share ``overlap`` along their shorter side. The robot drives along its image's u axis, at
    first ``heading`` radians from the plane's X axis.
    """
    turning, forward = np.zeros(count - 1), np.ones(count - 1)
    if path == "turn":
        bend = _phases(count - 1, (0.0, 0.35), (1.0, 0.3), (0.0, 0.35))
        turning = np.pi / 2 * bend / bend.sum()
    elif path == "parking":
        bend = _phases(count - 1, (0.0, 0.4), (1.0, 0.25), (-1.0, 0.25), (0.0, 0.1))
        forward = _phases(count - 1, (1.0, 0.4), (-1.0, 0.5), (1.0, 0.1))
        left, right = bend > 0.0, bend < 0.0
        turning[left], turning[right] = _PARKING_ANGLE / max(1, left.sum()), -_PARKING_ANGLE / max(1, right.sum())
    headings = heading + np.r_[0.0, np.cumsum(turning)]
    # On an arc, the chord points along the mean of the headings at its ends.
    chord = (headings[:-1] + headings[1:]) / 2.0
    length = (1.0 - overlap) * extent_of(lens, tilt).min()
    moves = length * forward[:, None] * np.column_stack([np.cos(chord), np.sin(chord)])
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    return Poses.of(places, focal_length(lens), -headings, tilt)


def survey_poses(
    lens: Lens,
    count: int,
    *,
    forward_overlap: float = 0.7,
    side_overlap: float = 0.5,
    height_jitter: float = 0.03,
    attitude_jitter: float = 0.0,
    tilt: Tilt = (0.0, 0.0),
    seed: int = 0,
) -> Poses:
    """A drone mows a nearly square field (paper Fig. 10: 117 and 158 frames).

    It takes ``count`` images, the last lane may be shorter; flies towards the top of its image, and turns round after
    each lane. Each height is changed by a random share within ± ``height_jitter``, ψ and θ by random angles within ±
    ``attitude_jitter`` radians.
    """
    extent = extent_of(lens, tilt)
    side, ahead = (1.0 - side_overlap) * extent[0], (1.0 - forward_overlap) * extent[1]
    lanes = max(1, round(np.sqrt(count * ahead / side)))
    per_lane = -(-count // lanes)
    lane, place = np.divmod(np.arange(count), per_lane)
    back = lane % 2 == 1
    places = np.column_stack([side * lane, -ahead * np.where(back, per_lane - 1 - place, place)])
    poses = Poses.of(places, focal_length(lens), np.where(back, np.pi, 0.0), tilt)
    return poses.shaken(seed=seed, position=0.05 * float(ahead), height=height_jitter, yaw=0.05, tilt=attitude_jitter)


def _phases(count: int, *phases: tuple[float, float]) -> NDArray[np.float64]:
    """``count`` values in phases (value, share of the count)."""
    ends = np.rint(count * np.cumsum([share for _, share in phases])).astype(int)
    return np.repeat([value for value, _ in phases], np.diff(np.r_[0, ends]))
