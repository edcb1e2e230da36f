"""Did a camera that turned also move? What is near is then not where a turn about the lens would put it.

With the turn taken away, a match of directions d1, d2 whose camera moved by t fulfils ``t · (d1 × d2) = 0``: what is
near moves along great circles through t, all of it the same way, and the farther the nearer it is (epipolar geometry of
a known rotation). Wrong matches and noise move anywhere. A thing that moves on its own may look like it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.camera import Camera
from rdstitch.matching.two_view import PairRegistration

_MIN_ERROR, _MAX_ERROR = 0.002, 0.15
"""Of an image's diagonal: between what noise does and what only wrong matches do."""

_MIN_MATCHES = 12
_MIN_SHARE = 0.05
"""Of the matches of a pair that are nearly right."""

_MIN_CONSISTENCY = 0.6
"""Share of the matches that are off that must be off along one translation."""

_TOLERANCE = 0.00125
"""Of an image's diagonal: distance from the great circle up to which a match is on it."""

_SAMPLES = 200


@dataclass(frozen=True)
class Parallax:
    """How far a pair of images is from a turn on the spot.

    Attributes
    ----------
    image1, image2 : int
    size : float
        Pixels that the nearest things are off by: the 95th percentile of the matches that are off.
    share : float
        Of the matches, in [0, 1], that are off.
    """

    image1: int
    image2: int
    size: float
    share: float


def find_parallax(alignment: Alignment, pairs: Sequence[PairRegistration], seed: int = 0) -> list[Parallax]:
    """The pairs of a turn on the spot between which the camera moved noticeably, the worst first.

    Parameters
    ----------
    alignment : Alignment
        With the model "rotation".
    pairs : sequence of PairRegistration
        With all their matches, right and wrong.
    seed : int
    """
    rng = np.random.default_rng(seed)
    registered = [pair for pair in pairs if pair.relation and alignment.used[[pair.image1, pair.image2]].all()]
    found = [parallax for pair in registered if (parallax := _parallax(alignment, pair, rng)) is not None]
    return sorted(found, key=lambda parallax: -parallax.size)


def _parallax(alignment: Alignment, pair: PairRegistration, rng: np.random.Generator) -> Parallax | None:
    """The parallax of a pair, if there is any."""
    i, j, matched = pair.image1, pair.image2, pair.correspondences
    diagonal = 2.0 * alignment.cameras[j].half_diagonal
    error = np.linalg.norm(alignment.transfer(i, j, matched.points1) - matched.points2, axis=1) / diagonal
    nearly = error < _MAX_ERROR
    off = nearly & (error > _MIN_ERROR)
    if off.sum() < max(_MIN_MATCHES, _MIN_SHARE * nearly.sum()):
        return None
    focal = (alignment.focal or 1.0) / 2.0  # of half diagonals, in diagonals
    first = _directions(alignment.cameras[i], alignment.homographies[i], matched.points1[off])
    second = _directions(alignment.cameras[j], alignment.homographies[j], matched.points2[off])
    along = _along_one_translation(first, second, _TOLERANCE / focal, rng)
    if along.sum() < max(_MIN_MATCHES, _MIN_CONSISTENCY * off.sum(), _MIN_SHARE * nearly.sum()):
        return None
    size = float(np.percentile(error[off][along], 95)) * diagonal
    return Parallax(i, j, size, float(along.sum() / nearly.sum()))


def _along_one_translation(
    first: FloatArray, second: FloatArray, tolerance: float, rng: np.random.Generator
) -> BoolArray:
    """Most of the pairs of directions (N, 3) that one translation moves, (N,); angles in radians."""
    normals = np.cross(first, second)
    one, other = rng.integers(len(normals), size=(2, _SAMPLES))
    translations = np.cross(normals[one], normals[other])
    length = np.linalg.norm(translations, axis=1, keepdims=True)
    translations /= np.maximum(length, 1e-300)
    # Angle between the second direction and the great circle through the first one and the translation.
    circles = np.linalg.norm(np.cross(translations[:, None], first), axis=2)
    on_circle = np.abs(translations @ normals.T) < tolerance * np.maximum(circles, 1e-12)
    forward = (translations @ (second - first).T) > 0.0
    best = max(
        (mask for way in (forward, ~forward) for mask in (on_circle & way)[length[:, 0] > 0.0]),
        key=np.count_nonzero,
        default=np.zeros(len(first), dtype=np.bool_),
    )
    return np.asarray(best, dtype=np.bool_)


def _directions(camera: Camera, matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Directions (N, 3), of length 1, of measured pixels (N, 2)."""
    flat = camera.normalize(camera.undistort(points))
    rays = np.column_stack([flat, np.ones(len(flat))]) @ matrix.T
    unit: FloatArray = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit
