"""How well an equirectangular panorama agrees with the true sphere, measured on the image alone."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from examples.judging.comparison import grey_and_filled, matches
from examples.judging.fitting import quantile
from examples.judging.patches import patch_displacements
from examples.worlds.turns import TurningSequence
from rdstitch.arrays import Float32Array, FloatArray

_ROUNDS = 3
_MIN_MATCHES = 12
_ROUGH = np.radians(2.0)
_GRID = 25  # places of an image, along each axis


@dataclass(frozen=True)
class SphereComparison:
    """A panorama beside the true sphere.

    ``error``: angles between what the panorama shows and what the best turn, size and horizon of the whole put there,
    radians; inf for patches that do not look like the sphere anywhere near; shape (P,).
    """

    error: FloatArray
    coverage: float  # share of the directions that the images show which the panorama shows

    def quantile(self, share: float) -> float:
        """So many of the errors are not above this, radians; inf where nothing was recognized."""
        return quantile(self.error, share) if len(self.error) else np.inf


@dataclass(frozen=True)
class _Placement:
    """Direction of each pixel: turn, pixels per radian, row of the horizon, column of longitude 0."""

    turn: FloatArray
    scale: float
    horizon: float
    column: float

    @classmethod
    def of(cls, parameters: FloatArray, column: float) -> "_Placement":
        return cls(
            Rotation.from_rotvec(parameters[:3]).as_matrix(), float(np.exp(parameters[3])), float(parameters[4]), column
        )

    def directions(self, places: FloatArray) -> FloatArray:
        """Of the sphere (..., 3), that the panorama's places (..., 2) should show."""
        longitude, latitude = (places[..., 0] - self.column) / self.scale, (places[..., 1] - self.horizon) / self.scale
        return np.asarray(_ahead(longitude, latitude) @ self.turn.T)

    def places(self, directions: FloatArray) -> FloatArray:
        """The panorama's places (N, 2) of directions (N, 3), within half a turn of its middle column."""
        x, y, z = (directions @ self.turn).T
        latitude = np.arctan2(y, np.hypot(x, z))
        return np.stack([self.column + self.scale * np.arctan2(x, z), self.horizon + self.scale * latitude], axis=1)


def compare_with_sphere(panorama: NDArray[Any], sequence: TurningSequence, search: int = 16) -> SphereComparison:
    """Lay a panorama on the true sphere, and measure how far each part of it is from where it belongs.

    ``panorama``: equirectangular, of any size, turned anyhow but nearly level; shape (h, w), (h, w, 3) or (h, w, 4).
    ``sequence``: the images that it was made of. ``search``: largest error that is told from a wrong place, pixels of
    the panorama.
    """
    grey, filled = grey_and_filled(panorama)
    width, height = sequence.texture.size[0] // 2, sequence.texture.size[1]
    truth, _ = grey_and_filled(np.rint(255.0 * sequence.texture.region(0, 0, width, height)).astype(np.uint8))
    shown, seen = matches(grey, filled, truth)
    column = (grey.shape[1] - 1) / 2
    start = _rough(shown, seen, width, column)
    if start is None:
        return SphereComparison(np.empty(0), 0.0)
    parameters = _fitted(start, shown, _sphere(seen, width), column, _ROUGH)
    for _ in range(_ROUNDS):
        placed = _Placement.of(parameters, column)
        y, x = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(np.float64)
        drawn = _drawn(truth, placed.directions(np.stack([x, y], axis=-1)))
        moves = patch_displacements(grey, drawn, filled, search)
        if moves.found.sum() < _MIN_MATCHES:
            return SphereComparison(np.empty(0), 0.0)
        there = placed.directions(moves.center + moves.displacement)
        parameters = _fitted(parameters, moves.center[moves.found], there[moves.found], column, 1.0 / placed.scale)
    placed = _Placement.of(parameters, column)
    angles = np.linalg.norm(np.cross(placed.directions(moves.center), there), axis=1)
    error = np.where(moves.found, angles, np.inf)
    return SphereComparison(error, _coverage(placed, filled, sequence))


def _rough(shown: FloatArray, seen: FloatArray, width: int, column: float) -> FloatArray | None:
    """Heading, size and horizon by a similarity of both images, since both are nearly level."""
    if len(shown) < _MIN_MATCHES:
        return None
    similarity, inliers = cv2.estimateAffinePartial2D(shown, seen, ransacReprojThreshold=30.0, maxIters=5000)
    if similarity is None or inliers.sum() < _MIN_MATCHES:
        return None
    ratio = float(np.hypot(*similarity[:, 0]))
    per_radian = width / (2.0 * np.pi)
    horizon = (width / 4.0 - 0.5 - similarity[1, 2] - similarity[1, 0] * column) / similarity[1, 1]
    ahead = similarity @ (column, horizon, 1.0)
    heading = (ahead[0] + 0.5) / per_radian
    return np.array([0.0, heading, 0.0, np.log(per_radian / ratio), horizon])


def _fitted(
    start: FloatArray, places: FloatArray, directions: FloatArray, column: float, tolerance: float
) -> FloatArray:
    """Turn, size and horizon by which places (N, 2) show directions (N, 3), the best for most of them."""

    def residuals(parameters: FloatArray) -> FloatArray:
        found: FloatArray = (_Placement.of(parameters, column).directions(places) - directions).ravel()
        return found

    return np.asarray(least_squares(residuals, start, loss="cauchy", f_scale=tolerance, x_scale="jac").x)


def _sphere(texels: FloatArray, width: int) -> FloatArray:
    """Directions (N, 3) of texels (N, 2) of the sphere's texture."""
    return _ahead(*((texels + 0.5) * (2.0 * np.pi / width) - (0.0, np.pi / 2)).T)


def _ahead(longitude: FloatArray, latitude: FloatArray) -> FloatArray:
    level = np.cos(latitude)
    return np.stack([np.sin(longitude) * level, np.sin(latitude), np.cos(longitude) * level], axis=-1)


def _drawn(truth: Float32Array, directions: FloatArray) -> Float32Array:
    """The sphere's texture (h, w) as directions (m, n, 3) show it."""
    x, y, z = np.moveaxis(directions, -1, 0)
    per_radian = truth.shape[1] / (2.0 * np.pi)
    across = np.mod(np.arctan2(x, z), 2.0 * np.pi) * per_radian - 0.5
    down = (np.arctan2(y, np.hypot(x, z)) + np.pi / 2) * per_radian - 0.5
    maps = (across.astype(np.float32), down.astype(np.float32))
    return np.asarray(cv2.remap(truth, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP), dtype=np.float32)


def _coverage(placed: _Placement, filled: NDArray[np.bool_], sequence: TurningSequence) -> float:
    """Share of the directions in images that the panorama shows; each image counts alike."""
    width, height = sequence.lens.image_size
    grid = np.stack(np.meshgrid(np.linspace(2, width - 3, _GRID), np.linspace(2, height - 3, _GRID)), -1).reshape(-1, 2)
    seen = placed.places(np.concatenate([sequence.rays(k, grid) for k in range(len(sequence))]))
    shown = np.zeros(len(seen), dtype=np.bool_)
    for turns in (-1, 0, 1):
        x, y = np.rint(seen + np.array([turns * 2.0 * np.pi * placed.scale, 0.0])).astype(int).T
        inside = (x >= 0) & (x < filled.shape[1]) & (y >= 0) & (y < filled.shape[0])
        shown[inside] |= filled[y[inside], x[inside]]
    return float(shown.mean())
