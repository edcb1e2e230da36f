"""Ready-made sequences of poses: pairs, grids, a robot's paths, a drone's survey.

All lie anywhere on the plane, which :func:`rdstitch.synthetic.sequence_over` makes large enough. The height follows
from ``texels_per_pixel``, the size of a pixel on the plane at the image's centre. Overlaps are shares of what the
lens sees of the plane along its middle row or column, so that a barrel lens takes longer steps.
"""

from dataclasses import replace
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.synthetic.lenses import Lens, focal_length
from rdstitch.synthetic.poses import Poses, plane_outline

Tilt = tuple[float, float]


class DriveOptions(TypedDict, total=False):
    """Options of :func:`drive_poses` that the ready-made paths pass on."""

    overlap: float
    heading: float
    tilt: Tilt
    texels_per_pixel: float


def pair_poses(
    lens: Lens,
    overlap: float = 0.3,
    *,
    yaw: float = 0.0,
    direction: float = 0.0,
    scale: float = 1.0,
    tilt: Tilt = (0.0, 0.0),
    texels_per_pixel: float = 1.0,
) -> Poses:
    """Two images.

    Parameters
    ----------
    overlap : float
        Share of the extent along ``direction`` that both images show.
    yaw : float
        Of the second image, radians.
    direction : float
        Where the camera goes, radians from the plane's X axis.
    scale : float
        Height of the second image in units of the first's.
    """
    along = np.array([np.cos(direction), np.sin(direction)])
    extent = np.min(_extent(lens, tilt, texels_per_pixel) / np.maximum(np.abs(along), 1e-12))
    height = texels_per_pixel * focal_length(lens) * np.array([1.0, scale])
    return Poses.of([(0.0, 0.0), (1.0 - overlap) * extent * along], height, [0.0, yaw], tilt)


def grid_poses(
    lens: Lens,
    columns: int,
    rows: int,
    *,
    overlap: float = 0.4,
    yaw: float = 0.0,
    shift: float = 0.0,
    tilt: Tilt = (0.0, 0.0),
    texels_per_pixel: float = 1.0,
    seed: int = 0,
) -> Poses:
    """Views side by side, row after row, each second row backwards.

    Parameters
    ----------
    overlap : float
        Of neighbours, along both axes.
    yaw : float
        Each image is turned by a random angle within ± this, radians.
    shift : float
        Each image is moved by a random share, within ± this, of the step to its neighbours.
    """
    step = (1.0 - overlap) * _extent(lens, tilt, texels_per_pixel)
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    j[1::2] = j[1::2, ::-1]
    places = np.column_stack([j.ravel(), i.ravel()]).astype(np.float64)
    places += shift * np.random.default_rng((seed, 1)).uniform(-1.0, 1.0, places.shape)
    poses = Poses.of(places * step, texels_per_pixel * focal_length(lens), 0.0, tilt)
    return poses.shaken(seed=seed, yaw=yaw)


def line_poses(lens: Lens, count: int, **options: Unpack[DriveOptions]) -> Poses:
    """A robot drives straight on (paper §5.5, "line"). Options as for :func:`drive_poses`."""
    return drive_poses(lens, np.zeros(count - 1), np.ones(count - 1), **options)


def turn_poses(lens: Lens, count: int, angle: float = np.pi / 2, **options: Unpack[DriveOptions]) -> Poses:
    """A robot drives straight on, turns by ``angle``, and drives on ("turn"). Options as for :func:`drive_poses`."""
    bend = _phases(count - 1, (0.0, 0.35), (1.0, 0.3), (0.0, 0.35))
    return drive_poses(lens, angle * bend / bend.sum(), np.ones(count - 1), **options)


def parking_poses(lens: Lens, count: int, angle: float = 0.7, **options: Unpack[DriveOptions]) -> Poses:
    """A robot passes the gap, backs into it in an S, and pulls up ("parallel parking").

    Parameters
    ----------
    angle : float
        How far it is turned in the middle of the S, radians.
    """
    bend = _phases(count - 1, (0.0, 0.4), (1.0, 0.25), (-1.0, 0.25), (0.0, 0.1))
    forward = _phases(count - 1, (1.0, 0.4), (-1.0, 0.5), (1.0, 0.1))
    left, right = bend > 0.0, bend < 0.0
    turning = np.zeros(count - 1)
    turning[left], turning[right] = angle / max(1, left.sum()), -angle / max(1, right.sum())
    return drive_poses(lens, turning, forward, **options)


def drive_poses(
    lens: Lens,
    turning: ArrayLike,
    forward: ArrayLike,
    *,
    overlap: float = 0.8,
    heading: float = 0.0,
    tilt: Tilt = (0.0, 0.0),
    texels_per_pixel: float = 1.0,
) -> Poses:
    """A robot with a camera that is fixed to it.

    Parameters
    ----------
    turning : array_like of shape (N - 1,)
        Change of heading in each step, radians.
    forward : array_like of shape (N - 1,)
        Length of each step in units of the step that ``overlap`` allows; negative in reverse.
    overlap : float
        Of consecutive images for a step of 1, along the image's shorter side.
    heading : float
        At the start, radians from the plane's X axis; the robot drives along its image's u axis.
    """
    turns, steps = np.asarray(turning, dtype=np.float64), np.asarray(forward, dtype=np.float64)
    length = (1.0 - overlap) * _extent(lens, tilt, texels_per_pixel).min()
    headings = heading + np.r_[0.0, np.cumsum(turns)]
    # On an arc, the chord points along the mean of the headings at its ends.
    chord = (headings[:-1] + headings[1:]) / 2.0
    moves = length * steps[:, None] * np.column_stack([np.cos(chord), np.sin(chord)])
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    return Poses.of(places, texels_per_pixel * focal_length(lens), -headings, tilt)


def survey_poses(
    lens: Lens,
    count: int,
    *,
    forward_overlap: float = 0.7,
    side_overlap: float = 0.5,
    there_and_back: bool = True,
    height_jitter: float = 0.03,
    attitude_jitter: float = 0.0,
    yaw_jitter: float = 0.05,
    tilt: Tilt = (0.0, 0.0),
    texels_per_pixel: float = 1.0,
    seed: int = 0,
) -> Poses:
    """A drone mows a nearly square field (paper Fig. 10: 117 and 158 frames).

    Parameters
    ----------
    count : int
        Images; the last lane may be shorter.
    forward_overlap, side_overlap : float
        Within a lane and between lanes. The drone flies towards the top of its image.
    there_and_back : bool
        Whether the drone turns round at the end of each lane; it flies back in reverse otherwise.
    height_jitter : float
        Each height is changed by a random share within ± this.
    attitude_jitter, yaw_jitter : float
        ψ, θ and the yaw are changed by random angles within ± this, radians.
    """
    extent = _extent(lens, tilt, texels_per_pixel)
    side, ahead = (1.0 - side_overlap) * extent[0], (1.0 - forward_overlap) * extent[1]
    lanes = max(1, round(np.sqrt(count * ahead / side)))
    per_lane = -(-count // lanes)
    lane, place = np.divmod(np.arange(count), per_lane)
    back = lane % 2 == 1
    places = np.column_stack([side * lane, -ahead * np.where(back, per_lane - 1 - place, place)])
    yaw = np.where(back & there_and_back, np.pi, 0.0)
    poses = Poses.of(places, texels_per_pixel * focal_length(lens), yaw, tilt)
    return poses.shaken(
        seed=seed, position=0.05 * float(ahead), height=height_jitter, yaw=yaw_jitter, tilt=attitude_jitter
    )


def rotation_poses(
    lens: Lens,
    count: int,
    *,
    yaw_step: float = 0.2,
    tilt: Tilt = (0.0, 0.0),
    tilt_jitter: float = 0.0,
    texels_per_pixel: float = 1.0,
    seed: int = 0,
) -> Poses:
    """A camera that turns on the spot. Without tilt jitter it turns about its axis, and λ cannot be seen."""
    poses = Poses.of(np.zeros((count, 2)), texels_per_pixel * focal_length(lens), yaw_step * np.arange(count), tilt)
    return poses.shaken(seed=seed, tilt=tilt_jitter)


def joined(*parts: Poses) -> Poses:
    """Sequences one after the other; each starts where the one before it ends, heading as it ended."""
    if not parts:
        raise ArgumentError("there is nothing to join")
    done = [parts[0]]
    for part in parts[1:]:
        last = done[-1]
        turn = last.yaw[-1] - part.yaw[0]
        c, s = np.cos(turn), np.sin(turn)
        places = (part.position - part.position[0]) @ np.array([[c, -s], [s, c]]) + last.position[-1]
        done.append(replace(part, position=places, yaw=part.yaw + turn))
    fields = {
        name: np.concatenate([getattr(part, name)[0 if k == 0 else 1 :] for k, part in enumerate(done)])
        for name in ("position", "height", "yaw", "tilt")
    }
    return Poses(**fields)


def _extent(lens: Lens, tilt: Tilt, texels_per_pixel: float) -> FloatArray:
    """Width and height in texels that an image shows of the plane along its middle row and column."""
    pose = Poses.of((0.0, 0.0), texels_per_pixel * focal_length(lens), 0.0, tilt)
    top, right, bottom, left = plane_outline(lens, pose.from_plane()[0], 2)[1::2]
    extent = np.array([np.linalg.norm(right - left), np.linalg.norm(bottom - top)])
    if not np.isfinite(extent).all():
        raise ArgumentError("the image sees beyond the horizon or beyond its lens")
    return extent


def _phases(count: int, *phases: tuple[float, float]) -> NDArray[np.float64]:
    """``count`` values in phases (value, share of the count)."""
    ends = np.rint(count * np.cumsum([share for _, share in phases])).astype(int)
    return np.repeat([value for value, _ in phases], np.diff(np.r_[0, ends]))
