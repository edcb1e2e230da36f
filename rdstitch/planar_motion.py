"""Homographies of planar motion: a camera that keeps its tilt and its height while it moves over a plane.

With tilt ``R = Rx(ψ) Ry(θ)``, yaw φ and translation ``t = (tx, ty, 0)`` in units of the height above the plane,
the homography from picture 1 to picture 2 is ``H ~ R Rz(φ) T R'``, ``T = I - t e3'`` (Valtonen Örnhag et al.,
eq. 1), in focal-normalized coordinates. When the second picture is taken from ``height`` times the height of the
first, it is ``H ~ R Rz(φ) diag(1, 1, height) T R'``.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray


def rotation_from_tilt(tilt: ArrayLike) -> FloatArray:
    """``R = Rx(ψ) Ry(θ)`` for tilts (ψ, θ) of shape (..., 2), radians; shape (..., 3, 3)."""
    angles = np.asarray(tilt, dtype=np.float64)
    sine, cosine = np.sin(angles), np.cos(angles)
    sin_x, sin_y = sine[..., 0], sine[..., 1]
    cos_x, cos_y = cosine[..., 0], cosine[..., 1]
    rotation = np.zeros((*angles.shape[:-1], 3, 3))
    rotation[..., 0, 0] = cos_y
    rotation[..., 0, 2] = sin_y
    rotation[..., 1, 0] = sin_x * sin_y
    rotation[..., 1, 1] = cos_x
    rotation[..., 1, 2] = -sin_x * cos_y
    rotation[..., 2, 0] = -cos_x * sin_y
    rotation[..., 2, 1] = sin_x
    rotation[..., 2, 2] = cos_x * cos_y
    return rotation


def tilt_from_normal(normal: ArrayLike) -> FloatArray:
    """Tilt (ψ, θ), radians, whose plane normal ``R e3`` is the direction of ``normal`` (..., 3)."""
    n = np.asarray(normal, dtype=np.float64)
    x, y, z = np.moveaxis(n / np.linalg.norm(n, axis=-1, keepdims=True), -1, 0)
    return np.stack([np.arctan2(-y, z), np.arcsin(np.clip(x, -1.0, 1.0))], axis=-1)


@dataclass(frozen=True)
class PlanarMotion:
    """Motion between two pictures of one camera over one plane.

    Attributes
    ----------
    tilt : (float, float)
        (ψ, θ), radians, of the camera to the plane, the same in both pictures.
    yaw : float
        φ, radians.
    translation : (float, float)
        (tx, ty) in units of the first picture's height above the plane.
    height : float
        Height of the second picture in units of the first's; 1 for planar motion.
    """

    tilt: tuple[float, float]
    yaw: float
    translation: tuple[float, float]
    height: float = 1.0

    def homography(self) -> FloatArray:
        """``H = R Rz(φ) diag(1, 1, height) T R'``, shape (3, 3), focal-normalized; its determinant is ``height``."""
        rotation = rotation_from_tilt(self.tilt)
        return rotation @ rigid_in_plane(self.yaw, self.translation, self.height) @ rotation.T

    @classmethod
    def from_homography(cls, homography: ArrayLike) -> Self:
        """The planar motion that a homography describes, or comes close to.

        The plane normal is a left eigenvector, ``H' n = height n``, because the motion keeps the distances from the
        plane. For φ = 0 and equal heights the eigenvalue is threefold; then ``H - I = -R t n'`` has rank one, and n
        spans its row space. Of all these candidates the one that reproduces H best is taken.

        Parameters
        ----------
        homography : array_like of shape (3, 3)
            In focal-normalized coordinates, of any scale and sign.
        """
        h = np.array(homography, dtype=np.float64)
        h = h / np.linalg.norm(h)
        row_space = np.linalg.svd(h - np.eye(3) * np.trace(h) / 3)[2][0]
        candidates = [cls.from_homography_and_normal(h, n) for n in (*np.linalg.eig(h.T)[1].T.real, row_space)]
        return min(candidates, key=lambda motion: motion._distance(h))

    @classmethod
    def from_homography_and_normal(cls, h: FloatArray, normal: FloatArray) -> Self:
        """The motion nearest to a homography (3, 3) for a given plane normal (3,) of any length and sign."""
        if not normal.any():
            normal = np.array([0.0, 0.0, 1.0])
        psi, theta = tilt_from_normal(normal if normal[2] >= 0.0 else -normal)
        rotation = rotation_from_tilt((psi, theta))
        motion = rotation.T @ h @ rotation
        scale = np.copysign(np.sqrt(np.abs(np.linalg.det(motion[:2, :2]))), motion[2, 2])
        motion = motion / (scale if scale != 0.0 else 1.0)
        yaw = float(np.arctan2(motion[1, 0] - motion[0, 1], motion[0, 0] + motion[1, 1]))
        c, s = np.cos(yaw), np.sin(yaw)
        tx, ty = -np.array([[c, s], [-s, c]]) @ motion[:2, 2]
        return cls((float(psi), float(theta)), yaw, (float(tx), float(ty)), float(motion[2, 2]))

    def _distance(self, unit: FloatArray) -> float:
        """Distance to a homography of unit norm, up to sign."""
        own = self.homography()
        own = own / np.linalg.norm(own)
        return float(min(np.linalg.norm(own - unit), np.linalg.norm(own + unit)))


def rigid_in_plane(yaw: float, translation: ArrayLike, height: float = 1.0) -> FloatArray:
    """``Rz(φ) diag(1, 1, height) T``, shape (3, 3): the motion as the plane sees it."""
    c, s = np.cos(yaw), np.sin(yaw)
    t = np.asarray(translation, dtype=np.float64)
    rotation = np.array([[c, -s], [s, c]])
    motion = np.zeros((3, 3))
    motion[:2, :2] = rotation
    motion[:2, 2] = -rotation @ t
    motion[2, 2] = height
    return motion


def constraint_residuals(homography: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Residuals of two constraints that every planar-motion homography satisfies (Valtonen Örnhag et al., §3).

    With ``S = (H + H')/2``, ``[v]x = (H - H')/2``, ``A = tr S``, ``t2 = tr S²``, ``t3 = tr S³``:

    * the quartic that is invariant to rotations of the camera frame,
      ``3A⁴ - 14A² t2 + 3 t2² - 4 t2 |v|² - 4|v|⁴ + 12 A t3 + 4 A v'Sv = 0``;
    * the sextic ``tr(adj H)³ = det(H) tr(H)³``.

    Parameters
    ----------
    homography : array_like of shape (..., 3, 3)
        In focal-normalized coordinates. The scale cancels: both are computed for unit Frobenius norm.

    Returns
    -------
    quartic, sextic : ndarray of shape (...)
    """
    h = np.asarray(homography, dtype=np.float64)
    h = h / np.linalg.norm(h, axis=(-2, -1), keepdims=True)
    transposed = np.swapaxes(h, -2, -1)
    s, skew = (h + transposed) / 2, (h - transposed) / 2
    v = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    a = np.einsum("...ii->...", s)
    t2 = np.einsum("...ij,...ji->...", s, s)
    t3 = np.einsum("...ij,...jk,...ki->...", s, s, s)
    v2 = np.einsum("...i,...i->...", v, v)
    vsv = np.einsum("...i,...ij,...j->...", v, s, v)
    quartic = 3 * a**4 - 14 * a**2 * t2 + 3 * t2**2 - 4 * t2 * v2 - 4 * v2**2 + 12 * a * t3 + 4 * a * vsv
    trace_adjugate = (a**2 - np.einsum("...ij,...ji->...", h, h)) / 2
    sextic = trace_adjugate**3 - np.linalg.det(h) * a**3
    return quartic, sextic
