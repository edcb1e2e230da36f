"""Frames of an alignment: images turned by EXIF as the camera stored them, and the image that is the plane.

Turned images are aligned as the camera stored them, so that its lens and its tilt are one in all. Matches, cameras and
homographies are those of upright images everywhere else. Mirrors stay where they are: of mirrored images among others
the distortion centre is mirrored too, which one lens of all cannot show.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.alignment.result import Alignment, PlanarPoses
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import LENS_PARAMETERS, Camera
from rdstitch.geometry.exif_orientation import inverse, quarter_turn, turning_matrix
from rdstitch.geometry.planar_motion import rigid_in_plane, rotation_from_tilt, tilt_from_normal
from rdstitch.inputs.source import Source
from rdstitch.matching.links import Link


@dataclass(frozen=True)
class QuarterTurns:
    """By which quarter turns of EXIF (1, 3, 6, 8) images became upright: what is known of them as the camera stored
    them, and back.
    """

    upright: tuple[int, ...]

    @classmethod
    def of(cls, sources: Sequence[Source]) -> Self:
        """Of images by their headers."""
        return cls(tuple(quarter_turn(source.metadata.orientation) for source in sources))

    @cached_property
    def back(self) -> tuple[int, ...]:
        """What leads back from upright images."""
        return tuple(inverse(orientation) for orientation in self.upright)

    @property
    def matrices_back(self) -> FloatArray:
        """Rotations (N, 3, 3) about the optical axis from upright images."""
        return _turns(self.back)

    def stored_camera(self, camera: Camera, image: int) -> Camera:
        """The camera of an image."""
        return camera.turned(self.back[image])

    def stored_tilts(self, tilts: FloatArray) -> FloatArray:
        """Tilts (ψ, θ) (N, 2), radians, of the cameras."""
        return _turned_tilts(tilts, self.back)

    def upright_tilts(self, tilts: FloatArray) -> FloatArray:
        """Tilts (ψ, θ) (N, 2), radians, of the upright images."""
        return _turned_tilts(tilts, self.upright)

    def stored_directions(self, directions: FloatArray) -> FloatArray:
        """Directions (N, 3), one in the axes of each upright image, in those of the cameras."""
        turned: FloatArray = np.einsum("nij,nj->ni", _turns(self.back), directions)
        return turned

    def stored_point(self, point: FloatArray, image: int) -> FloatArray:
        """A point (2,), from the middle of an upright image."""
        turned: FloatArray = turning_matrix(self.back[image]) @ point
        return turned

    def stored_link(self, link: Link, cameras: Sequence[Camera]) -> Link:
        """Correspondences of upright images of these cameras."""
        return _turned_link(link, cameras, self.back)

    def stored_alignment(self, alignment: Alignment) -> Alignment:
        """An alignment of upright images."""
        return _turned_alignment(alignment, self.back, None)

    def upright_alignment(self, alignment: Alignment, gravity: ArrayLike | None) -> Alignment:
        """An alignment of images as the camera stored them; gravity (N, 3) is down in the axes of the cameras."""
        down = None if gravity is None else np.einsum("nij,nj->ni", _turns(self.upright), np.asarray(gravity))
        return _turned_alignment(alignment, self.upright, down)


def _turns(orientations: Sequence[int]) -> FloatArray:
    """Rotations (N, 3, 3) about the optical axis by orientations 1, 3, 6 and 8."""
    matrices = np.tile(np.eye(3), (len(orientations), 1, 1))
    matrices[:, :2, :2] = [turning_matrix(orientation) for orientation in orientations]
    return matrices


def _turned_tilts(tilts: FloatArray, orientations: Sequence[int]) -> FloatArray:
    """Tilts (ψ, θ) (N, 2), radians, of images after orientations 1, 3, 6 and 8."""
    normals = rotation_from_tilt(tilts)[..., 2]
    turned = np.array(orientations)[:, None] != 1
    return np.where(turned, tilt_from_normal(np.einsum("nij,nj->ni", _turns(orientations), normals)), tilts)


def _turned_link(link: Link, cameras: Sequence[Camera], orientations: Sequence[int]) -> Link:
    """The same correspondences in images, of the cameras given, after orientations 1, 3, 6 and 8."""
    pair = orientations[link.image1], orientations[link.image2]
    if pair == (1, 1):
        return link
    first, second = _turns(pair)
    relation = link.relation
    return replace(
        link,
        points1=_turned_points(link.points1, cameras[link.image1], pair[0]),
        points2=_turned_points(link.points2, cameras[link.image2], pair[1]),
        relation=relation.reexpressed(
            second @ relation.homography @ first.T, relation.camera.turned(pair[0]), relation.camera2.turned(pair[1])
        ),
    )


def _turned_points(points: FloatArray, camera: Camera, orientation: int) -> FloatArray:
    return camera.turned(orientation).denormalize(camera.normalize(points) @ turning_matrix(orientation).T)


def _turned_alignment(alignment: Alignment, orientations: Sequence[int], gravity: FloatArray | None) -> Alignment:
    """The same alignment of the images after orientations 1, 3, 6 and 8, in the frame of the reference as it is then.

    Gravity (N, 3) is down in the axes of the cameras of the turned images; NaN where it is not known.
    """
    if all(orientation == 1 for orientation in orientations):
        return alignment
    turn, used, reference = _turns(orientations), alignment.used, alignment.reference
    turn_of_reference, poses, tilt = turn[reference], alignment.poses, alignment.tilt
    homographies = np.array(alignment.homographies)
    if alignment.on_sphere:
        matrices = turn[used] @ np.linalg.inv(homographies[used])
        matrices /= np.linalg.norm(matrices[:, 2], axis=1)[:, None, None]  # diag(f, f, 1) R
        place = int(used[:reference].sum())
        homographies[used] = levelled(matrices, place, None if gravity is None else gravity[used])
    else:
        plane = turn_of_reference
        if poses is not None:
            poses, plane = _turned_poses(poses, turn, reference)
        homographies[used] = plane @ homographies[used] @ turn[used].transpose(0, 2, 1)
    if tilt is not None:
        psi, theta = tilt_from_normal(turn_of_reference @ rotation_from_tilt(tilt)[:, 2]).tolist()
        tilt = (psi, theta)
    return replace(
        alignment,
        cameras=tuple(c.turned(o) for c, o in zip(alignment.cameras, orientations, strict=True)),
        homographies=homographies,
        poses=poses,
        tilt=tilt,
        covariance=_turned_covariance(alignment, turn_of_reference[:2, :2]),
    )


def _turned_poses(poses: PlanarPoses, turn: FloatArray, reference: int) -> tuple[PlanarPoses, FloatArray]:
    """The poses of cameras turned about their axes, yaw zero for the reference, and how that turns the plane (3, 3)."""
    rotation = turn @ rotation_from_tilt(poses.tilt) @ rigid_in_plane(poses.yaw, np.zeros(2))
    tilt = tilt_from_normal(rotation[..., 2])
    level = rotation_from_tilt(tilt).transpose(0, 2, 1) @ rotation
    yaw = np.arctan2(level[:, 1, 0], level[:, 0, 0])
    plane = rigid_in_plane(yaw[reference], np.zeros(2))
    yaw = np.remainder(yaw - yaw[reference] + np.pi, 2.0 * np.pi) - np.pi
    around = plane[:2, :2]
    return PlanarPoses(yaw, poses.position @ around.T, poses.height, tilt, *poses.turned(around)), plane


def _turned_covariance(alignment: Alignment, turn: FloatArray) -> FloatArray:
    """Covariance of the parameters of the lens and the tilt, to first order, in the frame of the turned reference."""
    names, jacobian = alignment.parameters, np.eye(len(alignment.parameters))
    for pair in (("psi", "theta"), LENS_PARAMETERS[3:]):
        if set(pair) <= set(names):
            index = [names.index(name) for name in pair]
            jacobian[np.ix_(index, index)] = turn
    covariance: FloatArray = jacobian @ alignment.covariance @ jacobian.T
    return covariance


_POINTS_PER_SIDE = 8
_REFERENCES_AT_ONCE = 32

_MAX_STRETCH = 10.0
"""Ratio of areas of what an image shows; seen from above a plane has up to 7."""


def in_frame_of(alignment: Alignment, reference: int) -> Alignment:
    """The same alignment with the undistorted image ``reference`` as its plane, and its height as unit of poses."""
    homographies = np.linalg.inv(alignment.homographies[reference]) @ alignment.homographies
    poses = alignment.poses
    if poses is not None and reference != alignment.reference:
        poses = poses.relative_to(reference)
    return replace(alignment, homographies=homographies, reference=reference, poses=poses)


def frontal_reference(alignment: Alignment) -> int:
    """The reference image, or, where its frame stretches another out of proportion, the one that stretches least."""
    used = np.flatnonzero(alignment.used)
    borders = np.stack([_border_on_plane(alignment, int(k)) for k in used])
    present = _nearest_to_horizon(borders, alignment.homographies[[alignment.reference]])
    if present.min() > _MAX_STRETCH ** (-1.0 / 3.0):  # areas grow with the third power
        return alignment.reference
    crossing, least = np.empty(len(used)), np.empty(len(used))
    for start in range(0, len(used), _REFERENCES_AT_ONCE):
        part = slice(start, start + _REFERENCES_AT_ONCE)
        nearness = _nearest_to_horizon(borders, alignment.homographies[used[part]])
        crossing[part], least[part] = (nearness <= 0.0).sum(axis=0), nearness.min(axis=0)
    return int(used[np.lexsort((-least, crossing))[0]])


def _border_on_plane(alignment: Alignment, image: int) -> FloatArray:
    """The border of an image on the plane, homogeneous (P, 3)."""
    camera = alignment.cameras[image]
    flat = camera.normalize(camera.undistort(camera.outline(_POINTS_PER_SIDE)))
    return np.asarray(np.column_stack([flat, np.ones(len(flat))]) @ alignment.homographies[image].T)


def _nearest_to_horizon(borders: FloatArray, references: FloatArray) -> FloatArray:
    """Smallest third coordinate of the borders (N, P, 3), in units of the largest, in frames of references (R, 3, 3).

    Shape (N, R).
    """
    third = borders @ np.linalg.inv(references)[:, 2].T
    return np.asarray(third.min(axis=1) / np.abs(third).max(axis=1))


_FULL_CIRCLE = np.pi / 2
"""Images whose centres leave no wider gap than this, radians, count as all the way round."""

_MAX_GRAVITY_SPREAD = np.radians(5.0)
"""Median angle between measured directions of gravity and their mean, up to which they are believed."""

_ROLL = np.radians(3.0)
"""Standard deviation of the roll of a camera that is held by hand: chosen."""

_STEEP = np.cos(np.radians(30.0))
"""Images that look within 30 degrees of straight up or down do not show how the camera was held."""


def levelled(matrices: FloatArray, reference: int, gravity: FloatArray | None = None) -> FloatArray:
    """Matrices (N, 3, 3) from undistorted coordinates of each image to directions in a level frame.

    The frame has x to the right, y down, and z towards the middle of what the images show, or towards the reference
    image where they show everything around. ``matrices`` are ``diag(f, f, 1) R_i``, from directions in any frame to the
    images; gravity (N, 3) is down in the axes of each camera, NaN where it has not measured it.
    """
    focal = float(np.linalg.norm(matrices[0, 0]))
    rotations = matrices / np.array([[focal], [focal], [1.0]])
    frame = level_frame(rotations, reference, measured_down(rotations, gravity))
    directions: FloatArray = frame @ np.swapaxes(rotations, 1, 2) @ np.diag([1.0, 1.0, focal])
    return directions


def measured_down(rotations: FloatArray, gravity: FloatArray | None) -> FloatArray | None:
    """Direction down (3,), in the frame that rotations (N, 3, 3) lead from, by gravity (N, 3) in the cameras' axes.

    None where no camera has measured it, or where the measurements contradict each other.
    """
    if gravity is None:
        return None
    down = np.einsum("nij,ni->nj", rotations, gravity)
    down = down[np.isfinite(down).all(axis=1)]
    if not len(down):
        return None
    mean = _unit(down.mean(axis=0))
    spread = float(np.median(np.arccos(np.clip(down @ mean, -1.0, 1.0))))
    return mean if spread < _MAX_GRAVITY_SPREAD else None


def level_frame(rotations: FloatArray, reference: int, down_by_gravity: FloatArray | None = None) -> FloatArray:
    """Rotation (3, 3) to the level frame from the one that rotations (N, 3, 3) lead from to the cameras.

    People hold cameras level, whichever way they turn them: the x axes of all images lie in one plane,
    and the direction down is the one they have least in common with (Brown and Lowe 2007, section 5). The less the
    images turn, beyond what hands roll, the more counts what is down in them; a few may be taken with the camera on its
    side. Gravity, where cameras have measured it, decides alone.
    """
    right, down, ahead = _upright(rotations)
    mean_down = _unit(down.mean(axis=0))
    spread, axes = np.linalg.eigh(right.T @ right)
    axis = axes[:, 0] * (1.0 if axes[:, 0] @ mean_down > 0.0 else -1.0)
    certainty = (spread[1] - spread[0]) / max(spread[1] + spread[0], 1e-12)
    certainty *= -math.expm1(-spread[1] / (2.0 * len(right) * _ROLL**2))  # that roll alone spreads them less (Rayleigh)
    y = _unit(certainty * axis + (1.0 - certainty) * mean_down) if down_by_gravity is None else down_by_gravity
    x = _unit(np.cross(y, ahead[reference]))
    z = np.cross(x, y)
    heading = _middle(np.arctan2(ahead @ x, ahead @ z))
    x, z = np.cos(heading) * x - np.sin(heading) * z, np.sin(heading) * x + np.cos(heading) * z
    return np.stack([x, y, z])


def _upright(rotations: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Axes right, down and ahead (N, 3) of cameras, turned by quarters about the last so that most agree on down."""
    right, down, ahead = np.moveaxis(rotations, 1, 0)
    usual = down[np.argmax(down @ down.sum(axis=0))]
    roll = np.rint(np.arctan2(right @ usual, down @ usual) / (np.pi / 2)) * (np.pi / 2)
    roll = np.where(np.abs(ahead @ usual) < _STEEP, roll, 0.0)[:, None]
    return np.cos(roll) * right - np.sin(roll) * down, np.sin(roll) * right + np.cos(roll) * down, ahead


def _middle(headings: FloatArray) -> float:
    """Middle of headings, radians: opposite to the widest gap between them; 0 where they go all the way round."""
    ordered = np.sort(headings)
    gaps = np.diff(np.append(ordered, ordered[0] + 2.0 * np.pi))
    widest = int(np.argmax(gaps))
    if gaps[widest] < _FULL_CIRCLE:
        return 0.0
    return float(ordered[widest] + gaps[widest] / 2.0 + np.pi)


def _unit(vector: FloatArray) -> FloatArray:
    unit: FloatArray = vector / max(float(np.linalg.norm(vector)), 1e-12)
    return unit
