"""Homography and distortion together: ``p2(λ) ~ H p1(λ)`` with the lifted point ``p(λ) = (x, y, 1 + λ(x² + y²))``.

:class:`RadialHomography` carries H, λ and their frame as one value. :func:`transfer` maps measured points to
measured points; :func:`transfer_jacobian` adds the analytic derivatives that pairwise refinement and the global
adjustment are both built on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.division_model import divisor, divisor_slope, measured_ratio
from rdstitch.geometry.planar_motion import PlanarMotion


def inverses(matrices: FloatArray) -> FloatArray:
    """Inverses of (N, 3, 3) by cofactors; not finite, instead of an exception, where a matrix is singular."""
    (a, b, c), (d, e, f), (g, h, i) = matrices.transpose(1, 2, 0)
    cofactors = np.empty((3, 3, len(matrices)))
    with np.errstate(all="ignore"):
        cofactors[:, 0] = e * i - f * h, f * g - d * i, d * h - e * g
        cofactors[:, 1] = c * h - b * i, a * i - c * g, b * g - a * h
        cofactors[:, 2] = b * f - c * e, c * d - a * f, a * e - b * d
        cofactors /= a * cofactors[0, 0] + b * cofactors[1, 0] + c * cofactors[2, 0]
    return np.ascontiguousarray(cofactors.transpose(2, 0, 1))


_MIN_DETERMINANT = 1e-6  # of H at unit norm; an image is then squeezed to a millionth of its area


def are_homographies(matrices: FloatArray) -> BoolArray:
    """Which of matrices (N, 3, 3) could relate two images of a plane: none is mirrored, or squeezed to a line."""
    with np.errstate(all="ignore"):
        unit = matrices / np.sqrt(np.einsum("nij,nij->n", matrices, matrices))[:, None, None]
        return np.asarray(np.linalg.det(unit) > _MIN_DETERMINANT)


def project(homogeneous: FloatArray) -> FloatArray:
    """(..., 3) to (..., 2); NaN at and behind the horizon (third coordinate not positive)."""
    third = homogeneous[..., 2:]
    return homogeneous[..., :2] / np.where(third > 0.0, third, np.nan)


def to_plane(camera: Camera, homography: FloatArray, points: ArrayLike) -> FloatArray:
    """Where measured points of an image, pixels (N, 2), lie on the plane; NaN at and beyond the horizon.

    ``homography`` (3, 3) leads from undistorted normalized coordinates to the plane, with positive third
    coordinates in front of the camera.
    """
    return _mapped(homography, camera.normalize(camera.undistort(points)))


def from_plane(camera: Camera, homography: FloatArray, points: ArrayLike) -> FloatArray:
    """Pixels where an image shows points (N, 2) of the plane: the inverse of :func:`to_plane`; NaN where it cannot."""
    back = np.asarray(np.linalg.inv(homography), dtype=np.float64)
    return camera.distort(camera.denormalize(_mapped(back, np.asarray(points, dtype=np.float64))))


def to_directions(camera: Camera, matrix: FloatArray, points: ArrayLike) -> FloatArray:
    """Directions (N, 3), of any length, of measured points of an image, pixels (N, 2), of a camera that only turned.

    ``matrix`` (3, 3) leads from undistorted normalized coordinates to directions.
    """
    flat = camera.normalize(camera.undistort(points))
    return np.concatenate([flat, np.ones((len(flat), 1))], axis=1) @ matrix.T


def from_directions(camera: Camera, matrix: FloatArray, directions: FloatArray) -> FloatArray:
    """Pixels (N, 2) where an image shows directions (N, 3), inverse of :func:`to_directions`; NaN where it cannot."""
    back = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return camera.distort(camera.denormalize(project(directions @ back.T)))


def _mapped(homography: FloatArray, points: FloatArray) -> FloatArray:
    return project(points @ homography[:, :2].T + homography[:, 2])


def transfer(homography: FloatArray, distortion: float, points: ArrayLike, higher: Sequence[float] = ()) -> FloatArray:
    """Where measured points of image 1 are measured in image 2: undistort, apply H, distort.

    By a homography (3, 3) from image 1 to image 2, with positive third coordinates in front of the camera, and λ in the
    frame of the points: of normalized points (N, 2), NaN for a point that comes to lie behind the camera or beyond the
    lens model. ``higher`` are μ and ν.
    """
    return transfer_points(homography, distortion, np.asarray(points, dtype=np.float64).T, higher)[2].T


@dataclass(frozen=True, eq=False)
class TransferJacobian:
    """N transferred points and their derivatives, all in normalized coordinates, the points last in memory."""

    points: FloatArray  # (N, 2): where the points of image 1 are measured in image 2
    by_image: FloatArray  # (2, 3, N): by ``z = H p``
    lifted: FloatArray  # (3, N): ``p``
    by_point: FloatArray  # (N, 2, 2): by the point in image 1
    by_divisor1: FloatArray  # (N, 2): by ``g`` of the lens at the point in image 1
    by_divisor2: FloatArray  # (N, 2): by ``g`` at the point in image 2
    squared_radius1: FloatArray  # (N,)
    squared_radius2: FloatArray  # (N,)

    @property
    def by_homography(self) -> FloatArray:
        """Derivatives by the entries of H, row by row, shape (N, 2, 9)."""
        return (self.by_image[:, :, None] * self.lifted).reshape(2, 9, -1).transpose(2, 0, 1)

    def by_lens(self, free: BoolArray) -> FloatArray:
        """Derivatives (2, K, N) by those of :data:`rdstitch.geometry.camera.LENS_PARAMETERS` that are ``free`` (5,).

        The centre shifts in both images.
        """
        columns = [
            self.by_divisor1.T * self.squared_radius1**power + self.by_divisor2.T * self.squared_radius2**power
            for power in (1, 2, 3)
            if free[power - 1]
        ]
        columns += [np.eye(2)[axis][:, None] - self.by_point[:, :, axis].T for axis in (0, 1) if free[3 + axis]]
        return np.stack(columns, axis=1) if columns else np.empty((2, 0, len(self.points)))


def transfer_points(
    homography: FloatArray, distortion: float, points: FloatArray, higher: Sequence[float] = ()
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """:func:`transfer` of points (2, N) by one homography (3, 3), or one a point (N, 3, 3).

    Their lifted points (3, N), the third coordinates (N,) that H gives these, and where they are measured (2, N).
    """
    lifted = np.empty((3, points.shape[1]))
    lifted[:2] = points
    lifted[2] = divisor(lifted[0] ** 2 + lifted[1] ** 2, distortion, higher)
    z = np.einsum("nij,jn->in", homography.reshape(-1, 3, 3), lifted)
    third = np.where(z[2] > 0.0, z[2], np.nan)
    flat = z[:2] / third
    flat *= measured_ratio(flat[0] ** 2 + flat[1] ** 2, distortion, higher)
    return lifted, third, flat


def transfer_jacobian(
    homography: FloatArray, distortion: float, points: FloatArray, higher: Sequence[float] = ()
) -> TransferJacobian:
    """:func:`transfer` with its analytic derivatives.

    With ``z = H p``, ``u = z_xy / z_w`` and d the distorted point, ``g`` of ``q = |d|²``: since ``u = d / g``, ``du/dd
    = (I - α d d') / g`` with ``α = 2 g'/g``, whose inverse is ``dd/du = g (I + α d d' / (1 - αq))``; and at fixed u
    ``dd/dλ = d q / (g (1 - αq))``, for μ and ν with the next powers of q. There is one homography for all points (N,
    2), or one a point, (N, 3, 3); points that cannot be transferred give NaN everywhere.
    """
    # Coordinates first, points last: so every operation runs along the points, which are many.
    lifted, w, d = transfer_points(homography, distortion, points.T, higher)
    r2, rho2 = (x**2 + y**2 for x, y in (lifted[:2], d))
    g = divisor(rho2, distortion, higher)
    alpha = 2.0 * divisor_slope(rho2, distortion, higher) / g
    stretch = 1.0 - alpha * rho2
    # d by z: that by u, over w, for the first two; and -u / w, of which "d by u" makes -d / (stretch w), for the third.
    scale = g / w
    d_by_z = np.empty((2, 3, len(points)))
    np.multiply((d * (scale * alpha / stretch))[:, None], d, out=d_by_z[:, :2])
    d_by_z[0, 0] += scale
    d_by_z[1, 1] += scale
    np.multiply(d, -1.0 / (stretch * w), out=d_by_z[:, 2])

    by_lifted = np.einsum("ikn,nkj->ijn", d_by_z, homography.reshape(-1, 3, 3))
    along_third = by_lifted[:, 2]
    slope = lifted[:2] * (2.0 * divisor_slope(r2, distortion, higher))
    by_point = (by_lifted[:, :2] + along_third[:, None] * slope).transpose(2, 0, 1)
    return TransferJacobian(d.T, d_by_z, lifted, by_point, along_third.T, (d / (g * stretch)).T, r2, rho2)


def measurement_whitening(by_point: FloatArray, common: FloatArray | None = None) -> FloatArray:
    """Whitening of a transfer error whose noise comes from both images (Sampson's weighting).

    A point measured with the same noise in both images is transferred with covariance ``I + J J'``, J = ``by_point``
    (N, 2, 2) the derivative of the transferred by the original point, both in pixels. The upper triangular ``W`` has
    ``W'W = ((I + J J') / 2)⁻¹``: of the size of the error in one image. ``common`` (N, 2), a random displacement of the
    transferred point of one standard deviation, over that of the noise, adds its square to the covariance.
    """
    (ax, ay), (bx, by) = by_point.transpose(1, 2, 0)
    xx, yy, xy = (1.0 + ax * ax + ay * ay) / 2.0, (1.0 + bx * bx + by * by) / 2.0, (ax * bx + ay * by) / 2.0
    if common is not None:
        xx, yy, xy = xx + common[:, 0] ** 2, yy + common[:, 1] ** 2, xy + common[:, 0] * common[:, 1]
    whitening = np.zeros_like(by_point)
    slope = xy / yy
    conditional = 1.0 / np.sqrt(xx - xy * slope)
    whitening[:, 0, 0] = conditional
    whitening[:, 0, 1] = -slope * conditional
    whitening[:, 1, 1] = 1.0 / np.sqrt(yy)
    return whitening


def whiten(whitening: FloatArray, values: FloatArray) -> FloatArray:
    """``W v`` of values (2, ..., N), W upper triangular (N, 2, 2); written out, several times faster than matmul."""
    result = np.empty_like(values)
    np.multiply(whitening[:, 0, 0], values[0], out=result[0])
    result[0] += whitening[:, 0, 1] * values[1]
    np.multiply(whitening[:, 1, 1], values[1], out=result[1])
    return result


@dataclass(frozen=True, repr=False, eq=False)
class RadialHomography:
    """The relation of two images of a plane: homography, λ, and how far both can be trusted.

    A fit that failed is falsy and carries the reason.

    Attributes
    ----------
    homography : ndarray of shape (3, 3)
        ``p2(λ) ~ H p1(λ)`` for points normalized by half the diagonal of their image; NaN after a failure.
    camera : Camera
        The camera of image 1, with the estimated λ (0 after a failure) and the focal length that was used.
    camera2 : Camera
        The same lens on image 2, which may have another size.
    inliers : ndarray of shape (N,), bool
        Correspondences that agree with this model.
    covariance : ndarray of shape (P, P)
        Of :attr:`parameters`; empty after a failure.
    distortion_std : float
        Standard deviation of λ in the half-diagonal frame; inf where λ is not observable, 0 where it was given.
    model : str
        "rigid", "similarity" or "homography": the least free model that explains the data.
    motion : PlanarMotion or None
        The motion where the model is one of planar motion.
    rms : float
        Root mean square error of the inliers: of their transfer, pixels of image 2, over what one pixel in each image
        does to it.
    solver : str
        Minimal solver that found the model.
    iterations : int
        Samples drawn.
    reason : str
        Why this model was chosen, or why the fit failed.
    ok : bool
    parameters : tuple of str
        "distortion", if λ was estimated and is observable, then the free parameters of the model: "psi" and "theta" of
        the tilt and "yaw", radians, "tx" and "ty" in heights, "log_height" of the change of height, "log_focal"; or
        "tangent_1" to "tangent_8", orthonormal directions that change a homography of unit norm.
    """

    homography: FloatArray
    camera: Camera
    camera2: Camera
    inliers: NDArray[np.bool_]
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    distortion_std: float = np.inf
    model: str = ""
    motion: PlanarMotion | None = None
    rms: float = np.nan
    solver: str = ""
    iterations: int = 0
    reason: str = ""
    ok: bool = True
    parameters: tuple[str, ...] = ()

    @classmethod
    def failed(cls, reason: str, camera: Camera, camera2: Camera, count: int, iterations: int = 0) -> Self:
        """A fit of ``count`` correspondences that failed, with the reason."""
        none = np.zeros(count, dtype=np.bool_)
        h = np.full((3, 3), np.nan)
        return cls(h, camera, camera2, none, iterations=iterations, reason=reason, ok=False)

    def reexpressed(self, homography: FloatArray, camera: Camera, camera2: Camera) -> Self:
        """The relation with another homography, or the same in other frames, without what was of the one before."""
        moved = replace(self, homography=homography, camera=camera, camera2=camera2)
        return replace(moved, covariance=np.empty((0, 0)), parameters=(), motion=None)

    def __repr__(self) -> str:
        if not self.ok:
            return f"<RadialHomography failed: {self.reason}>"
        agreeing = f"{int(self.inliers.sum())} of {len(self.inliers)} inliers"
        known = f"λ = {self.distortion:.4f}" if self.distortion_observable else "λ not observable"
        return f"<RadialHomography {self.model}, {agreeing}, {known}, rms {self.rms:.2f} pixels>"

    def __bool__(self) -> bool:
        """Check whether the fit succeeded."""
        return self.ok

    @property
    def distortion(self) -> float:
        """λ for half the image diagonal; NaN after a failure."""
        return self.camera.distortion if self.ok else np.nan

    @property
    def distortion_observable(self) -> bool:
        """Whether the images determine λ."""
        return self.ok and bool(np.isfinite(self.distortion_std))

    @property
    def homography_px(self) -> FloatArray:
        """H from undistorted pixels of image 1 to undistorted pixels of image 2, shape (3, 3)."""
        to_px = _pixel_matrix(self.camera2)
        return to_px @ self.homography @ np.linalg.inv(_pixel_matrix(self.camera))

    def transfer(self, points1: ArrayLike) -> FloatArray:
        """Measured pixels of image 1 (N, 2) to measured pixels of image 2; NaN where there is no such point."""
        normalized = self.camera.normalize(points1)
        moved = transfer(self.homography, self.camera.distortion, normalized, self.camera.higher)
        return self.camera2.denormalize(moved)


def _pixel_matrix(camera: Camera) -> FloatArray:
    """Matrix (3, 3) from half-diagonal-normalized to pixel coordinates."""
    s, (cx, cy) = camera.scale, camera.center
    return np.array([[s, 0.0, cx], [0.0, s, cy], [0.0, 0.0, 1.0]])
