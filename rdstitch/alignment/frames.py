"""Frames of an alignment: images turned by EXIF as the camera stored them, and the image that is the plane.

Turned images are aligned as the camera stored them, so that its lens and its tilt are one in all. Matches, cameras and
homographies are those of upright images everywhere else. Mirrors stay where they are: of mirrored images among others
the distortion centre is mirrored too, which one lens of all cannot show.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment.layout import MAX_STRETCH
from rdstitch.alignment.result import Alignment, PlanarPoses
from rdstitch.alignment.rotation_frame import levelled
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.camera import LENS_PARAMETERS, Camera
from rdstitch.matching.links import Link
from rdstitch.orientation import inverse, turning_matrix
from rdstitch.planar_motion import rigid_in_plane, rotation_from_tilt, tilt_from_normal


def turns(orientations: Sequence[int]) -> FloatArray:
    """Rotations (N, 3, 3) about the optical axis by orientations 1, 3, 6 and 8."""
    matrices = np.tile(np.eye(3), (len(orientations), 1, 1))
    matrices[:, :2, :2] = [turning_matrix(orientation) for orientation in orientations]
    return matrices


def turned_tilts(tilts: FloatArray, orientations: Sequence[int]) -> FloatArray:
    """Tilts (ψ, θ) (N, 2), radians, of images after orientations 1, 3, 6 and 8."""
    normals = rotation_from_tilt(tilts)[..., 2]
    turned = np.array(orientations)[:, None] != 1
    return np.where(turned, tilt_from_normal(np.einsum("nij,nj->ni", turns(orientations), normals)), tilts)


def turned_link(link: Link, cameras: Sequence[Camera], orientations: Sequence[int]) -> Link:
    """The same correspondences in images, of the cameras given, after orientations 1, 3, 6 and 8."""
    own = orientations[link.image1], orientations[link.image2]
    if own == (1, 1):
        return link
    first, second = turns(own)
    relation = link.relation
    return replace(
        link,
        points1=_turned_points(link.points1, cameras[link.image1], own[0]),
        points2=_turned_points(link.points2, cameras[link.image2], own[1]),
        relation=replace(
            relation,
            homography=second @ relation.homography @ first.T,
            camera=relation.camera.turned(own[0]),
            camera2=relation.camera2.turned(own[1]),
            covariance=np.empty((0, 0)),
            motion=None,
        ),
    )


def _turned_points(points: FloatArray, camera: Camera, orientation: int) -> FloatArray:
    return camera.turned(orientation).denormalize(camera.normalize(points) @ turning_matrix(orientation).T)


def turned_alignment(alignment: Alignment, orientations: Sequence[int], gravity: FloatArray | None) -> Alignment:
    """The same alignment of the images after orientations 1, 3, 6 and 8, in the frame of the reference as it is then.

    Gravity (N, 3) is down in the axes of the cameras of the turned images; NaN where it is not known.
    """
    if all(orientation == 1 for orientation in orientations):
        return alignment
    turn, used, reference = turns(orientations), alignment.used, alignment.reference
    own, poses, tilt = turn[reference], alignment.poses, alignment.tilt
    homographies = np.array(alignment.homographies)
    if alignment.on_sphere:
        matrices = turn[used] @ np.linalg.inv(homographies[used])
        matrices /= np.linalg.norm(matrices[:, 2], axis=1)[:, None, None]  # diag(f, f, 1) R
        place = int(used[:reference].sum())
        homographies[used] = levelled(matrices, place, None if gravity is None else gravity[used])
    else:
        plane = own
        if poses is not None:
            poses, plane = _turned_poses(poses, turn, reference)
        homographies[used] = plane @ homographies[used] @ turn[used].transpose(0, 2, 1)
    if tilt is not None:
        psi, theta = tilt_from_normal(own @ rotation_from_tilt(tilt)[:, 2]).tolist()
        tilt = (psi, theta)
    return replace(
        alignment,
        cameras=tuple(c.turned(o) for c, o in zip(alignment.cameras, orientations, strict=True)),
        homographies=homographies,
        poses=poses,
        tilt=tilt,
        covariance=_turned_covariance(alignment, own[:2, :2]),
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


def _turned_covariance(alignment: Alignment, own: FloatArray) -> FloatArray:
    """Covariance of the parameters of the lens and the tilt, to first order, in the frame of the turned reference."""
    names, jacobian = alignment.parameters, np.eye(len(alignment.parameters))
    for pair in (("psi", "theta"), LENS_PARAMETERS[3:]):
        if set(pair) <= set(names):
            index = [names.index(name) for name in pair]
            jacobian[np.ix_(index, index)] = own
    covariance: FloatArray = jacobian @ alignment.covariance @ jacobian.T
    return covariance


def stored(orientations: Sequence[int]) -> tuple[int, ...]:
    """What leads back from upright images."""
    return tuple(inverse(orientation) for orientation in orientations)


_POINTS_PER_SIDE = 8


def in_frame_of(alignment: Alignment, reference: int) -> Alignment:
    """The same alignment with the undistorted image ``reference`` as its plane, and its height as unit of poses."""
    homographies = np.linalg.inv(alignment.homographies[reference]) @ alignment.homographies
    poses = alignment.poses
    if poses is not None and reference != alignment.reference:
        poses = poses.relative_to(reference)
    return replace(alignment, homographies=homographies, reference=reference, poses=poses)


def frontal_reference(alignment: Alignment) -> int:
    """The reference image, or, where another one is absurdly stretched by its frame, the one that stretches least."""
    used = np.flatnonzero(alignment.used)
    nearness = np.array([_nearest_to_horizon(alignment, used, int(k)) for k in used])
    own = int(np.flatnonzero(used == alignment.reference)[0])
    if nearness[own].min() > MAX_STRETCH ** (-1.0 / 3.0):  # areas grow with the third power
        return alignment.reference
    crossing, least = (nearness <= 0.0).sum(axis=1), nearness.min(axis=1)
    return int(used[np.lexsort((-least, crossing))[0]])


def _nearest_to_horizon(alignment: Alignment, used: IntArray, reference: int) -> FloatArray:
    """Smallest third coordinate of each image's border in the frame of ``reference``, in units of the largest."""
    values = []
    for index in used:
        camera, relation = alignment.cameras[index], alignment.relation(int(index), reference)
        flat = camera.normalize(camera.undistort(camera.outline(_POINTS_PER_SIDE)))
        third = flat @ relation[2, :2] + relation[2, 2]
        values.append(float(third.min() / np.abs(third).max()))
    return np.array(values)
