"""What no model of the family describes, as small changes of the measured points that undo it.

A lens whose axis is off the middle, images that were cropped, rows that are read one after the other while the camera
moves, a surface that is curved: where such a thing is small, images of it are those of the model with their points
moved a little.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit
from rdstitch.alignment.lens_selection import CENTER
from rdstitch.alignment.link_equations import split_lens
from rdstitch.alignment.motion_models import LOG_HEIGHT, PlanarModel, X, Y, inverses
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.division_model import distort, undistort
from rdstitch.radial_homography import project

Correction = Callable[[FloatArray, IntArray, float], FloatArray]
"""Takes measured points (M, 2), half diagonals, the image of each (M,), and the size of the effect to the points that
the model would have measured."""

OFF_CENTER = "a lens whose axis is off the middle (were the images cropped?)"
OTHER_LENS = "a lens of another kind"
ROLLING_SHUTTER = "rows that were read while the camera moved (a rolling shutter)"
CURVED = "a curved surface"
CROPPED = "images that were cropped, or stabilised, each differently"
USUAL_FOCAL = "a usual focal length, far from the one that fits best"

_STEP = 1e-4
"""Of differences by an effect's size."""

_PATTERNS = 8
"""Random ways in which images are tried to be cropped: as many for few images as for many."""


@dataclass(frozen=True)
class Effect:
    """One thing that is not modelled."""

    cause: str  # which kind of thing it is
    correct: Correction
    std: float  # how large it usually is, where nothing is known of it
    largest: float | None = None  # how large it is in an extreme case; no larger if not given

    def displacement(self, points: FloatArray, images: IntArray) -> FloatArray:
        """Derivative (M, 2) of the corrected points by the size."""
        ahead, behind = (self.correct(points, images, size) for size in (_STEP, -_STEP))
        derivative: FloatArray = (ahead - behind) / (2.0 * _STEP)
        return derivative


def unmodelled_effects(fit: Fit) -> list[Effect]:
    """What a fit leaves out: of its lens, of the shutter, and of the ground where poses are metric."""
    lens, free = fit.adjusted.parameters.lens, fit.free_lens
    effects = []
    if not free[CENTER].any():
        effects += [Effect(OFF_CENTER, _shifted(axis), 0.03) for axis in (0, 1)]
    if not free[1]:
        effects.append(Effect(OTHER_LENS, _bent(lens), 0.03))
    # The camera's motion shears and stretches what its rows see, and so do pixels that are no squares: by a tenth where
    # an image passes in ten read-outs.
    effects += [Effect(ROLLING_SHUTTER, _sheared(np.array(matrix)), 0.01, 0.1) for matrix in _SHEARS]
    if isinstance(fit.model, PlanarModel):
        # At the most, the camera is as far from the surface as the centre of its curvature.
        effects += [Effect(CURVED, _curved(fit, fit.model, axes), 0.05, 1.0) for axes in ((0, 0), (0, 1), (1, 1))]
    return effects


def cropping_effects(count: int) -> list[Effect]:
    """The lens's axis lies elsewhere in each of so many images, in several random ways."""
    patterns = np.random.default_rng(0).normal(0.0, 1.0, (_PATTERNS, count, 2))
    return [Effect(CROPPED, _cropped(pattern), 0.03) for pattern in patterns]


_SHEARS = ([[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [0.0, 0.0]])


def _shifted(axis: int) -> Correction:
    """The distortion centre lies elsewhere."""
    return lambda points, images, size: points - size * np.eye(2)[axis]


def _cropped(pattern: FloatArray) -> Correction:
    """The distortion centre lies elsewhere in each image, by its row of (N, 2)."""
    return lambda points, images, size: points - size * pattern[images]


def _sheared(matrix: FloatArray) -> Correction:
    """The image is changed linearly."""
    return lambda points, images, size: points + size * points @ matrix.T


def _bent(lens: FloatArray) -> Correction:
    """μ is another one."""
    more = np.array([0.0, 1.0, 0.0, 0.0, 0.0])
    return lambda points, images, size: _distorted(undistorted(points, lens + size * more), lens)


def _curved(fit: Fit, model: PlanarModel, axes: tuple[int, int]) -> Correction:
    """The ground is a paraboloid, its height one half of ``size`` times two coordinates, in heights of the camera."""
    adjusted = fit.adjusted
    poses = model.metric_poses(adjusted.parameters.poses, adjusted.parameters.shared)
    position, height = poses[:, [X, Y]], np.exp(poses[:, LOG_HEIGHT])
    to_image, middle, lens = adjusted.matrices.matrices, position.mean(axis=0), adjusted.parameters.lens
    to_ground = inverses(to_image)

    def correct(points: FloatArray, images: IntArray, size: float) -> FloatArray:
        foot = mapped(to_ground[images], undistorted(points, lens))
        a, b = (foot - middle)[:, axes].T
        below = position[images]
        place = below + (foot - below) * (1.0 - 0.5 * size * a * b / height[images])[:, None]
        return _distorted(mapped(to_image[images], place), lens)

    return correct


def undistorted(points: FloatArray, lens: FloatArray) -> FloatArray:
    """Measured points (M, 2), half diagonals, without the lens (5,)."""
    distortion, higher, center = split_lens(lens)
    return undistort(points - center, distortion, higher)


def _distorted(points: FloatArray, lens: FloatArray) -> FloatArray:
    distortion, higher, center = split_lens(lens)
    measured: FloatArray = distort(points, distortion, higher) + center
    return measured


def mapped(homographies: FloatArray, points: FloatArray) -> FloatArray:
    """Points (M, 2), each by its own homography (M, 3, 3)."""
    return project(np.einsum("mij,mj->mi", homographies[:, :, :2], points) + homographies[:, :, 2])
