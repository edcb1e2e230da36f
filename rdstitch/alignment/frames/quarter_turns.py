"""Images that EXIF turned, as the camera stored them, so that its lens and its tilt are one in all.

Matches, cameras and homographies are those of upright images everywhere else. Mirrors stay where they are: of mirrored
images among others the distortion centre is mirrored too, which one lens of all cannot show.
"""

from collections.abc import Collection, Sequence
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
    """Quarter turns of images by orientations of EXIF (1, 3, 6, 8), and what is known of the images after them."""

    orientations: tuple[int, ...]

    @classmethod
    def of(cls, sources: Sequence[Source]) -> Self:
        """The turns by which images became upright, by their headers."""
        return cls(tuple(quarter_turn(source.metadata.orientation) for source in sources))

    @cached_property
    def back(self) -> "QuarterTurns":
        """The inverse ones: those that lead back from upright images to stored ones."""
        return QuarterTurns(tuple(map(inverse, self.orientations)))

    @property
    def none(self) -> bool:
        """Whether no image is turned."""
        return set(self.orientations) <= {1}

    @cached_property
    def matrices(self) -> FloatArray:
        """Rotations (N, 3, 3) about the optical axis."""
        matrices = np.tile(np.eye(3), (len(self.orientations), 1, 1))
        matrices[:, :2, :2] = [turning_matrix(orientation) for orientation in self.orientations]
        return matrices

    def camera(self, camera: Camera, image: int) -> Camera:
        """The camera of an image."""
        return camera.turned(self.orientations[image])

    def tilts(self, tilts: FloatArray) -> FloatArray:
        """Tilts (ψ, θ) (N, 2), radians, of the cameras."""
        normals = self.directions(rotation_from_tilt(tilts)[..., 2])
        return np.where(np.array(self.orientations)[:, None] != 1, tilt_from_normal(normals), tilts)

    def directions(self, directions: ArrayLike) -> FloatArray:
        """Directions (N, 3), one in the axes of each camera."""
        return np.asarray(np.einsum("nij,nj->ni", self.matrices, np.asarray(directions)))

    def point(self, point: FloatArray, image: int) -> FloatArray:
        """A point (2,), from the middle of an image."""
        return self.matrices[image, :2, :2] @ point

    def link(self, link: Link, cameras: Sequence[Camera]) -> Link:
        """Correspondences of images of these cameras."""
        images, relation = [link.image1, link.image2], link.relation
        if all(self.orientations[k] == 1 for k in images):
            return link
        points1, points2 = (
            self.camera(cameras[k], k).denormalize(cameras[k].normalize(points) @ self.matrices[k, :2, :2].T)
            for k, points in zip(images, (link.points1, link.points2), strict=True)
        )
        camera, camera2 = self.camera(relation.camera, link.image1), self.camera(relation.camera2, link.image2)
        turned = self.matrices[link.image2] @ relation.homography @ self.matrices[link.image1].T
        relation = relation.reexpressed(turned, camera, camera2)
        return replace(link, points1=points1, points2=points2, relation=relation)

    def alignment(
        self, alignment: Alignment, gravity: ArrayLike | None = None, near_copies: Collection[int] = ()
    ) -> Alignment:
        """An alignment, in the frame of the reference as it is after its turn.

        Gravity (N, 3) is down in the axes of the cameras before the turns; NaN where it is not known. Near copies do
        not tell what is level.
        """
        if self.none:
            return alignment
        turn, used, reference = self.matrices, alignment.used, alignment.reference
        poses, homographies = alignment.poses, np.array(alignment.homographies)
        if alignment.on_sphere:
            matrices = turn[used] @ np.linalg.inv(homographies[used])
            matrices /= np.linalg.norm(matrices[:, 2], axis=1)[:, None, None]  # diag(f, f, 1) R
            place = int(used[:reference].sum())
            down = None if gravity is None else self.directions(gravity)[used]
            counted = ~np.isin(np.flatnonzero(used), list(near_copies))
            homographies[used] = levelled(matrices, place, down, counted)
        else:
            plane = turn[reference]
            if poses is not None:
                poses, plane = _turned_poses(poses, turn, reference)
            homographies[used] = plane @ homographies[used] @ turn[used].transpose(0, 2, 1)
        return replace(
            alignment,
            cameras=tuple(self.camera(camera, k) for k, camera in enumerate(alignment.cameras)),
            homographies=homographies,
            poses=poses,
            covariance=_turned_covariance(alignment, turn[reference, :2, :2]),
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
    return jacobian @ alignment.covariance @ jacobian.T
