"""The best similarity or homography between two sets of points: what a mosaic may differ by from the true plane."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError


def apply(transform: ArrayLike, points: ArrayLike) -> FloatArray:
    """Points (..., 2) through a homography (3, 3); inf on its horizon."""
    x = np.asarray(points, dtype=np.float64)
    h = np.asarray(transform, dtype=np.float64)
    mapped = x @ h[:, :2].T + h[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        quotient: FloatArray = mapped[..., :2] / mapped[..., 2:]
    return quotient


def fit_similarity(source: ArrayLike, target: ArrayLike) -> FloatArray:
    """Rotation, scale and shift (never a reflection) that minimise the sum of squared distances in ``target``.

    ``source``, ``target``: at least two different points; shape (N, 2). Returns Umeyama's closed form in the plane,
    from source to target. Raises :class:`ArgumentError` when the points determine no similarity.
    """
    a, b = _checked(source, target, 2)
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    u, v = a - mean_a, b - mean_b
    spread = np.sum(u**2)
    if spread == 0.0:
        raise ArgumentError("all points are the same: they determine no similarity")
    cosine = np.sum(u * v) / spread
    sine = np.sum(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / spread
    linear = np.array([[cosine, -sine], [sine, cosine]])
    return _affine(linear, mean_b - linear @ mean_a)


def fit_homography(source: ArrayLike, target: ArrayLike) -> FloatArray:
    """Homography that minimises the sum of squared distances in ``target``.

    ``source``, ``target``: at least four points (N, 2), no three of four on a line. Returns the normalized direct
    linear transform, refined by least squares; from source to target, ``H[2, 2] = 1``. Raises :class:`ArgumentError`
    when the points determine no homography.
    """
    a, b = _checked(source, target, 4)
    to_a, to_b = _normalization(a), _normalization(b)
    p, q = apply(to_a, a), apply(to_b, b)
    lifted, zeros = np.column_stack([p, np.ones(len(p))]), np.zeros((len(p), 3))
    rows = [np.hstack([lifted, zeros, -q[:, :1] * lifted]), np.hstack([zeros, lifted, -q[:, 1:] * lifted])]
    singular, basis = np.linalg.svd(np.concatenate(rows), full_matrices=False)[1:]
    if len(singular) < 8 or singular[7] < 1e-10 * singular[0]:
        raise ArgumentError("the points determine no homography")

    def off(h: FloatArray) -> FloatArray:
        residual: FloatArray = apply(h.reshape(3, 3), p) - q
        return residual.ravel()

    found = least_squares(off, basis[-1], xtol=1e-13, ftol=1e-15, gtol=1e-15)
    h = np.linalg.inv(to_b) @ found.x.reshape(3, 3) @ to_a
    return np.asarray(h / h[2, 2])


FITS = {"similarity": fit_similarity, "homography": fit_homography}


def quantile(errors: FloatArray, share: float) -> float:
    """The smallest error that ``share`` of the errors do not exceed. Not interpolated, because errors may be inf."""
    ordered = np.sort(errors)
    return float(ordered[min(len(ordered) - 1, int(np.ceil(share * len(ordered))) - 1)])


def _checked(source: ArrayLike, target: ArrayLike, least: int) -> tuple[FloatArray, FloatArray]:
    """Both sets of points, if their shapes fit."""
    a, b = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 2 or len(a) < least:
        raise ArgumentError(f"expected two arrays of at least {least} points (N, 2), not {a.shape} and {b.shape}")
    return a, b


def _normalization(points: FloatArray) -> FloatArray:
    """Similarity that moves the centre to the origin and gives the points a mean square distance of 2."""
    mean = points.mean(axis=0)
    scale = np.sqrt(np.mean(np.sum((points - mean) ** 2, axis=1)) / 2.0)
    if scale == 0.0:
        raise ArgumentError("all points are the same")
    return _affine(np.eye(2) / scale, -mean / scale)


def _affine(linear: FloatArray, shift: FloatArray) -> FloatArray:
    """Matrix (3, 3) of ``linear x + shift``."""
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = linear, shift
    return matrix
