"""Images that EXIF turned, as the camera stored them, so that its lens and its tilt are one in all.

Matches, cameras and homographies are those of upright images everywhere else. Mirrors stay where they are: of mirrored
images among others the distortion centre is mirrored too, which one lens of all cannot show.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.alignment.frames.level_frame import levelled
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
        turns = self.back[link.image1], self.back[link.image2]
        if turns == (1, 1):
            return link
        relation, (first, second) = link.relation, _turns(turns)
        camera, camera2 = relation.camera.turned(turns[0]), relation.camera2.turned(turns[1])
        return replace(
            link,
            points1=_turned_points(link.points1, cameras[link.image1], turns[0]),
            points2=_turned_points(link.points2, cameras[link.image2], turns[1]),
            relation=relation.reexpressed(second @ relation.homography @ first.T, camera, camera2),
        )

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


def _turned_points(points: FloatArray, camera: Camera, orientation: int) -> FloatArray:
    return camera.turned(orientation).denormalize(camera.normalize(points) @ turning_matrix(orientation).T)


def _turned_alignment(alignment: Alignment, orientations: Sequence[int], gravity: FloatArray | None) -> Alignment:
    """The same alignment of the images after orientations 1, 3, 6 and 8, in the frame of the reference as it is then.

    Gravity (N, 3) is down in the axes of the cameras of the turned images; NaN where it is not known.
    """
    if all(orientation == 1 for orientation in orientations):
        return alignment
    turn, used, reference = _turns(orientations), alignment.used, alignment.reference
    turn_of_reference, poses = turn[reference], alignment.poses
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
    return replace(
        alignment,
        cameras=tuple(c.turned(o) for c, o in zip(alignment.cameras, orientations, strict=True)),
        homographies=homographies,
        poses=poses,
        covariance=_turned_covariance(alignment, turn_of_reference[:2, :2]),
    )


def _turned_poses(poses: PlanarPoses, turn: FloatArray, reference: int) -> tuple[PlanarPoses, FloatArray]:
    """The poses of cameras turned about their axes, yaw zero for the reference, and how that turns the plane (3, 3)."""
    rotation = turn @ rotation_from_tilt(poses.tilt) @ rigid_in_plane(poses.yaw, np.zeros(2))
    tilt = tilt_from_normal(rotation[..., 2])
    level = rotation_from_tilt(tilt).transpose(0, 2, 1) @ rotation
    yaw = np.arctan2(level[:, 1, 0], level[:, 0, 0])
    plane = rigid_in_plane(yaw[reference], np.zeros(2))
    covariance, with_first = poses.turned(plane[:2, :2])
    relative = PlanarPoses(yaw, poses.position, poses.height, tilt).relative_to(reference)
    return replace(relative, covariance=covariance, with_first=with_first), plane


def _turned_covariance(alignment: Alignment, turn: FloatArray) -> FloatArray:
    """Covariance of the parameters of the lens and the tilt, to first order, in the frame of the turned reference."""
    names, jacobian = alignment.parameters, np.eye(len(alignment.parameters))
    for pair in (("psi", "theta"), LENS_PARAMETERS[3:]):
        if set(pair) <= set(names):
            index = [names.index(name) for name in pair]
            jacobian[np.ix_(index, index)] = turn
    covariance: FloatArray = jacobian @ alignment.covariance @ jacobian.T
    return covariance
