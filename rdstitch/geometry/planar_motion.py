"""Homographies of planar motion: a camera that keeps its tilt and its height while it moves over a plane.

With tilt ``R = Rx(ψ) Ry(θ)``, yaw φ and translation ``t = (tx, ty, 0)`` in units of the height above the plane,
the homography from image 1 to image 2 is ``H ~ R Rz(φ) T R'``, ``T = I - t e3'`` (Valtonen Örnhag et al.,
eq. 1), in focal-normalized coordinates. When the second image is taken from ``height`` times the height of the
first, it is ``H ~ R Rz(φ) diag(1, 1, height) T R'``.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray

ABOUT_X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
ABOUT_Y = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
ABOUT_Z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
"""Generators of rotations: with ``R = Rx(ψ) Ry(θ)`` the derivatives by ψ and θ are ``ABOUT_X R`` and ``R ABOUT_Y``."""


def nearest_rotation(matrices: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) nearest to matrices, up to a positive scale (orthogonal Procrustes, Kabsch)."""
    left, _, right = np.linalg.svd(matrices)
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


def rotation_about(vectors: ArrayLike) -> FloatArray:
    """Rotations (..., 3, 3) about vectors (..., 3) by their lengths, radians (Rodrigues)."""
    about = np.asarray(vectors, dtype=np.float64)
    angles = np.linalg.norm(about, axis=-1)[..., None, None]
    cross = np.einsum("...k,kij->...ij", about, np.stack([ABOUT_X, ABOUT_Y, ABOUT_Z]))
    first, second = np.sinc(angles / np.pi), 0.5 * np.sinc(angles / (2.0 * np.pi)) ** 2
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def rotation_from_tilt(tilt: ArrayLike) -> FloatArray:
    """``R = Rx(ψ) Ry(θ)`` for tilts (ψ, θ) of shape (..., 2), radians; shape (..., 3, 3)."""
    angles = np.asarray(tilt, dtype=np.float64)
    (sx, sy), (cx, cy) = (np.moveaxis(of(angles), -1, 0) for of in (np.sin, np.cos))
    rows = (cy, np.zeros_like(cy), sy), (sx * sy, cx, -sx * cy), (-cx * sy, sx, cx * cy)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def tilt_from_normal(normal: ArrayLike) -> FloatArray:
    """Tilt (ψ, θ), radians, whose plane normal ``R e3`` is the direction of ``normal`` (..., 3)."""
    n = np.asarray(normal, dtype=np.float64)
    x, y, z = np.moveaxis(n / np.linalg.norm(n, axis=-1, keepdims=True), -1, 0)
    return np.stack([np.arctan2(-y, z), np.arcsin(np.clip(x, -1.0, 1.0))], axis=-1)


def turned_tilt(tilt: tuple[float, float], turning: FloatArray) -> tuple[float, float]:
    """The tilt (ψ, θ), radians, of an image whose directions, to the right and down, are turned by a matrix (2, 2)."""
    *direction, ahead = rotation_from_tilt(tilt)[:, 2]
    psi, theta = tilt_from_normal([*turning @ direction, ahead]).tolist()
    return psi, theta


@dataclass(frozen=True)
class PlanarMotion:
    """Motion between two images of one camera over one plane."""

    tilt: tuple[float, float]  # (ψ, θ), radians, of the camera to the plane, the same in both images
    yaw: float  # φ, radians
    translation: tuple[float, float]  # (tx, ty) in units of the first image's height above the plane
    height: float = 1.0  # height of the second image in units of the first's; 1 for planar motion

    def homography(self) -> FloatArray:
        """``H = R Rz(φ) diag(1, 1, height) T R'``, shape (3, 3), focal-normalized; its determinant is ``height``."""
        rotation = rotation_from_tilt(self.tilt)
        return rotation @ rigid_in_plane(self.yaw, self.translation, self.height) @ rotation.T

    @classmethod
    def from_homography(cls, homography: ArrayLike, normal: FloatArray | None = None) -> Self:
        """The planar motion that a homography (3, 3) comes closest to, for a plane normal (3,) if given."""
        h = np.array(homography, dtype=np.float64)
        row = motions_from_homographies(h[None], None if normal is None else normal[None])[0]
        psi, theta, yaw, tx, ty, height = row.tolist()
        return cls((psi, theta), yaw, (tx, ty), height)


def motions_from_homographies(homography: FloatArray, normal: FloatArray | None = None) -> FloatArray:
    """Rows (ψ, θ, φ, tx, ty, height), (B, 6), of planar motions nearest to focal-normalized homographies (B, 3, 3).

    The plane normal is a left eigenvector, ``H' n = height n``, because the motion keeps the distances from the plane.
    For φ = 0 and equal heights the eigenvalue is threefold; then ``H - I = -R t n'`` has rank one, and n spans its row
    space. Of all these candidates the one that reproduces H best is taken; or normals (B, 3) of any length and sign
    are given.
    """
    if normal is not None:
        return _motions_for_normals(homography, normal)
    h = homography / np.linalg.norm(homography, axis=(1, 2), keepdims=True)
    turned = h - np.eye(3) * np.trace(h, axis1=1, axis2=2)[:, None, None] / 3
    level = np.broadcast_to([[0.0, 0.0, 1.0]], (len(h), 1, 3))  # of the identity any normal would do
    eigenvectors = np.swapaxes(np.linalg.eig(np.swapaxes(h, 1, 2))[1].real, 1, 2)
    normals = np.concatenate([level, eigenvectors, np.linalg.svd(turned)[2][:, :1]], axis=1)
    count = normals.shape[1]
    motions = _motions_for_normals(np.repeat(h, count, axis=0), normals.reshape(-1, 3)).reshape(-1, count, 6)
    rotation = rotation_from_tilt(motions[..., :2])
    fit = rotation @ rigid_in_plane(motions[..., 2], motions[..., 3:5], motions[..., 5]) @ np.swapaxes(rotation, -2, -1)
    fit = fit / np.linalg.norm(fit, axis=(-2, -1), keepdims=True)
    distance = [np.linalg.norm(fit - sign * h[:, None], axis=(-2, -1)) for sign in (1.0, -1.0)]
    best = np.minimum(*distance).argmin(axis=1)
    return np.asarray(motions[np.arange(len(h)), best])


def _motions_for_normals(h: FloatArray, normal: FloatArray) -> FloatArray:
    """Rows of :func:`motions_from_homographies` for given normals."""
    normal = np.where(normal.any(axis=1, keepdims=True), normal, [0.0, 0.0, 1.0])
    tilt = tilt_from_normal(np.where(normal[:, 2:] >= 0.0, normal, -normal))
    rotation = rotation_from_tilt(tilt)
    return np.column_stack([tilt, *nearest_in_plane(np.swapaxes(rotation, 1, 2) @ h @ rotation)])


def rigid_in_plane(yaw: ArrayLike, translation: ArrayLike, height: ArrayLike = 1.0) -> FloatArray:
    """``Rz(φ) diag(1, 1, height) T`` of shape (..., 3, 3): motions as the plane sees them; angles (...), t (..., 2)."""
    angle, t = np.asarray(yaw, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    c, s = np.cos(angle), np.sin(angle)
    motion = np.zeros((*angle.shape, 3, 3))
    motion[..., 0, 0], motion[..., 0, 1] = c, -s
    motion[..., 1, 0], motion[..., 1, 1] = s, c
    motion[..., 0, 2] = -(c * t[..., 0] - s * t[..., 1])
    motion[..., 1, 2] = -(s * t[..., 0] + c * t[..., 1])
    motion[..., 2, 2] = height
    return motion


def nearest_in_plane(motion: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Yaws (B,), translations (B, 2) and heights (B,) of :func:`rigid_in_plane` nearest to matrices (B, 3, 3).

    The matrices may be of any scale and sign.
    """
    area = motion[:, 0, 0] * motion[:, 1, 1] - motion[:, 0, 1] * motion[:, 1, 0]
    scale = np.copysign(np.sqrt(np.abs(area)), motion[:, 2, 2])
    motion = motion / np.where(scale != 0.0, scale, 1.0)[:, None, None]
    yaw = np.arctan2(motion[:, 1, 0] - motion[:, 0, 1], motion[:, 0, 0] + motion[:, 1, 1])
    c, s, x, y = np.cos(yaw), np.sin(yaw), motion[:, 0, 2], motion[:, 1, 2]
    return yaw, np.stack([-c * x - s * y, s * x - c * y], axis=1), motion[:, 2, 2]
