"""Is the shape of the whole known? Overlaps that agree to a fifth of a pixel do not say so.

Each image hangs on its neighbours only, so what bends all overlaps alike, a lens whose axis is off the middle or a
wall that is slightly curved, adds up along a row of images: homographies, tilts and heights take it up, and the far
end is off by pixels where every seam is good. So the fit is tried against what it leaves out: a lens whose axis is off
the middle, images that were cropped, rows that are read one after the other while the camera moves, a surface that is
curved. Where such a thing is small, images of it are those of the model with their points moved a little. How much
smaller would the errors be, how well do the images exclude it, and how far would the images move, up to one homography
of the whole?

What is tried is a sample of what may be missing. So the fit is probed besides for what differs from image to image:
where that would make the errors smaller by more than noise does, the model is wrong even with the effects, and standard
deviations that suppose it right are too small by as much: they are multiplied by the Birge ratio (R. T. Birge, The
calculation of errors by the method of least squares, 1932).

Effects are tried as large as they usually are. Of a much larger one, such as a wall whose radius is a few times the
camera's distance, that prior would allow little: so extreme cases are tried, too. And a row of few images fits a
curved wall by a strong tilt and a focal length that next to no lens has: then the usual focal length is tried.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.bundle_adjustment import BundleAdjuster, Parameters, inverse_information
from rdstitch.alignment.lens_selection import CENTER
from rdstitch.alignment.linear_response import LinearResponse
from rdstitch.alignment.link_equations import LinearizedErrors, split_lens
from rdstitch.alignment.motion_models import LOG_HEIGHT, PlanarModel, X, Y
from rdstitch.alignment.observations import Observations
from rdstitch.alignment.result import ShapeTest
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.division_model import distort, undistort
from rdstitch.geometry.radial_homography import inverses, project
from rdstitch.robust.loss import ALIGNMENT_WIDTH
from rdstitch.robust.posterior import MODEL_ERROR

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
"""Of differences: sizes of an effect, standard deviations of a shared parameter, and half diagonals."""

_PATTERNS = 8
"""Random ways in which images are tried to be cropped: as many for few images as for many."""


@dataclass(frozen=True, eq=False)
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


_LARGE = 0.004
"""Of an image's diagonal: an image may be off by less; sets wrong by three pixels of 500 have 0.005 and more."""

_SHOWN_PER_EFFECT = 4.0
"""Gain of each effect, in squared standard deviations, from which on the images show that something is left out."""

UNLIKELY_FOCAL = 4.0
"""Standard deviations of what is known of a focal length beyond which it may stand for something else."""

_SIDE = 6
"""Points along a side of each image whose places are compared."""

_IMAGES_AT_ONCE = 256

_ENOUGH, _MIN_MATCHES_PER_LINK = 6000, 8
"""Correspondences in all, and of each link at least, that say what the shape is."""

_NO_ROBUSTNESS = 1e9
"""Pixels: a width of the loss at which it is the square."""


def judge_shape(problem: Problem, fit: Fit, cameras: Sequence[Camera]) -> ShapeTest:
    """Try a fit of a model over a plane against what it leaves out; the cameras are those of the problem's images."""
    effects, probes = unmodelled_effects(fit), cropping_effects(problem.count)
    answers = _Answers.of(problem, fit, [*effects, *probes])
    stds = np.array([effect.std for effect in answers.effects])
    usual_stds, extreme_stds = stds[: len(effects)], np.array([effect.largest or effect.std for effect in effects])
    probed = (answers.gain(stds) - answers.gain(usual_stds)) / len(probes)
    moved = _displacements(answers, fit, len(effects), cameras)

    def per_image(products: FloatArray) -> FloatArray:
        """Root mean square (N,) over each image, from the products (C, C) of what moves it."""
        return np.asarray(np.sqrt(np.maximum(np.einsum("nst,st->n", moved, products), 0.0)))

    def predict(stds: FloatArray) -> _Prediction:
        sizes, covariance = answers.estimate(stds)
        gain, spread = answers.gain(stds), per_image(max(1.0, probed) * covariance)
        shifts = per_image(np.outer(sizes, sizes))
        return _Prediction(gain, gain / len(stds), shifts, spread, _cause(effects, sizes, covariance))

    large = _LARGE * np.array([2.0 * camera.scale for camera in cameras])
    judged = usual = predict(usual_stds)
    off = np.hypot(usual.shifts, usual.stds)
    # Extreme cases count where the errors show them. Where the images only fail to exclude them, as along any row, no
    # image would be good enough.
    doubtful = bool(off.max() > large[off.argmax()])
    if not doubtful and answers.gain(extreme_stds) > _SHOWN_PER_EFFECT * len(effects):
        extreme = predict(extreme_stds)
        if (extreme.shifts > large).any():
            doubtful, judged, off = True, extreme, extreme.shifts
    beside = log_focal_deviation(problem, fit)
    if not doubtful and abs(beside) > UNLIKELY_FOCAL * problem.camera_priors.log_focal_std:
        by_focal = np.delete(answers.shared[len(fit.adjusted.parameters.shared) - 1], np.s_[len(effects) : len(stds)])
        follow = answers.estimate(usual_stds)[1] @ by_focal  # all that moves with the focal length
        shifts = per_image(np.outer(follow, follow) * (beside / (by_focal @ follow)) ** 2)
        if (shifts > large).any():
            doubtful, off = True, shifts
            judged = _Prediction(usual.gain, 0.0, shifts, np.zeros_like(shifts), USUAL_FOCAL)
    image = int(off.argmax())
    return ShapeTest(
        doubtful=doubtful,
        gain=judged.gain,
        shown=max(judged.by_effect, probed) > _SHOWN_PER_EFFECT,
        image=image,
        shift=float(judged.shifts[image]),
        shift_std=float(judged.stds[image]),
        cause=CROPPED if probed > max(judged.by_effect, _SHOWN_PER_EFFECT) else judged.cause,
    )


def log_focal_deviation(problem: Problem, fit: Fit) -> float:
    """By how much the logarithm of a fit's focal length exceeds what was known of it; 0 where no tilt shows one."""
    if not isinstance(fit.model, PlanarModel):
        return 0.0
    log_focal = float(fit.model.physical_parameters(fit.adjusted.parameters.shared)[0][-1])
    return log_focal - problem.camera_priors.log_focal


@dataclass(frozen=True, eq=False)
class _Prediction:
    """What effects would change: gain in squared standard deviations, in all and by effect; pixels (N,); the cause."""

    gain: float
    by_effect: float
    shifts: FloatArray
    stds: FloatArray
    cause: str


@dataclass(frozen=True, eq=False)
class _Answers:
    """How an adjustment answers E effects of unit size, and its S shared parameters as they are without these."""

    adjuster: BundleAdjuster
    effects: Sequence[Effect]
    # poses, shared: (N, D, E + S) and (S, E + S): steps of the poses, and of the shared parameters
    poses: FloatArray
    shared: FloatArray
    # information, gradient: (E, E) and (E,): on the sizes of the effects, by what the parameters do not absorb
    information: FloatArray
    gradient: FloatArray
    covariance: FloatArray  # (S, S): of the shared parameters without the effects

    @classmethod
    def of(cls, problem: Problem, fit: Fit, effects: Sequence[Effect]) -> Self:
        """At a fit of the problem, by the inliers; no error says more than :data:`MODEL_ERROR` allows."""
        adjuster = problem.adjuster_of(fit)
        o = _inliers(adjuster, fit)
        adjuster, at = (
            replace(adjuster, observations=o),
            replace(fit.adjusted, sigma=math.hypot(fit.adjusted.sigma, MODEL_ERROR)),
        )
        normal, weight = adjuster.normal_equations(at, _NO_ROBUSTNESS), adjuster.weight(at.sigma)
        response = LinearResponse(adjuster, at, np.full(len(o.points1), weight), 1.0, normal)
        link, count = o.link, len(effects)

        def fields(part: LinearizedErrors) -> FloatArray:
            """How the errors change (m, 2, E)."""
            changes = np.zeros((*part.errors.shape, count))
            for by, points, images in ((part.by_point1, o.points1, o.image1), (part.by_point2, o.points2, o.image2)):
                measured = points[part.rows], images[link[part.rows]]
                changes += by @ np.nan_to_num(np.stack([each.displacement(*measured) for each in effects], axis=2))
            return changes

        poses, shared = response.steps_of(fields, count)
        information = np.zeros((count, count))
        gradient = np.einsum("ndc,nd->c", poses, normal.gradient_poses) + shared.T @ normal.gradient_shared
        for part in response.parts():
            changes = fields(part)
            left = changes + response.changes(part, poses, shared)
            weighted = weight * changes.reshape(-1, count)
            gradient += weighted.T @ part.errors.ravel()
            information += weighted.T @ left.reshape(-1, count)
        covariance = normal.responses(np.zeros_like(normal.coupling), -np.eye(len(shared)))[1]
        return cls(
            adjuster,
            effects,
            np.concatenate([poses, normal.pose_response()], axis=2),
            np.hstack([shared, np.eye(len(shared))]),
            (information + information.T) / 2.0,
            gradient,
            covariance,
        )

    def estimate(self, stds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sizes of the first effects, by their standard deviations (K,), and of the shared parameters; covariance."""
        count, shared = len(stds), len(self.covariance)
        covariance = np.zeros((count + shared,) * 2)
        covariance[:count, :count] = inverse_information(self.information[:count, :count] + np.diag(stds**-2.0))
        covariance[count:, count:] = self.covariance
        return -covariance[:, :count] @ self.gradient[:count], covariance

    def gain(self, stds: FloatArray) -> float:
        """By how much the first effects, of these standard deviations, lessen the cost, squared standard deviations."""
        count = len(stds)
        return -float(self.gradient[:count] @ self.estimate(stds)[0][:count])


def _inliers(adjuster: BundleAdjuster, fit: Fit) -> Observations:
    """As many observations as say what the shape is, without those that the fit does not explain."""
    few = adjuster.observations.thinned_to(_ENOUGH, _MIN_MATCHES_PER_LINK)
    squared = replace(adjuster, observations=few).squared(fit.adjusted.parameters)
    kept = squared <= (ALIGNMENT_WIDTH * fit.adjusted.sigma) ** 2
    return few.rows(np.flatnonzero(kept), np.bincount(few.link[kept], minlength=len(few)))


def _displacements(answers: _Answers, fit: Fit, count: int, cameras: Sequence[Camera]) -> FloatArray:
    """How far points all over each image move in it, pixels, as mean products (N, K + S, K + S) of what moves them.

    These are the first K effects, of unit size, and the shared parameters; up to one homography of the whole.
    """
    grid = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, _SIDE)] * 2), axis=-1).reshape(-1, 2)
    free, parameters = answers.adjuster.free, fit.adjusted.parameters

    def ground(measured: FloatArray, images: IntArray, at: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Where measured points lie on the plane, by the images' matrices and the lens; NaN beyond the horizon."""
        return mapped(at[0][images], undistorted(measured, at[1]))

    def state(parameters: Parameters) -> tuple[FloatArray, FloatArray]:
        return inverses(fit.model.matrices(parameters.poses, parameters.shared).matrices), parameters.lens

    of_shared = np.sqrt(np.maximum(np.diag(answers.covariance), 1e-300))
    sizes = [_STEP] * count + (_STEP * of_shared).tolist()
    columns = [*range(count), *range(len(answers.effects), answers.poses.shape[2])]
    moved = []
    for size, column in zip(sizes, columns, strict=True):
        poses = answers.poses[..., column] * size
        moved.append(state(parameters.retract(fit.model, poses, answers.shared[:, column] * size, free.lens)))
    here = state(parameters)

    def measured(images: IntArray, places: FloatArray) -> tuple[FloatArray, IntArray]:
        """Places (P, 2) of these images, as shares of each, in half diagonals; and the image of each."""
        points = [cameras[k].normalize(places * (np.array(cameras[k].image_size) - 1.0)) for k in images]
        return np.concatenate(points), np.repeat(images, len(places))

    every = np.arange(len(cameras))
    # Corners alone may all lie beyond what a fisheye shows of the ground.
    diagonal = ground(*measured(every, grid[:: _SIDE + 1]), here)
    middle, spread = np.nanmean(diagonal, axis=0), max(float(np.nanstd(diagonal)), 1e-12)
    products, points = [], []
    for images in np.split(every, np.arange(_IMAGES_AT_ONCE, len(every), _IMAGES_AT_ONCE)):
        at, of = measured(images, grid)
        on_ground, on_plane = ground(at, of, here), []
        for index, (size, now) in enumerate(zip(sizes, moved, strict=True)):
            step = size * answers.effects[index].displacement(at, of) if index < count else 0.0
            on_plane.append((ground(at + step, of, now) - on_ground) / size)
        flat = (on_ground - middle) / spread
        on_plane += [
            np.outer(values, unit).reshape(-1, 2) for values in (np.ones(len(flat)), *flat.T) for unit in np.eye(2)
        ]
        on_plane += [flat * flat[:, [axis]] for axis in (0, 1)]
        by_point = np.stack(
            [(ground(at + step, of, here) - ground(at - step, of, here)) / (2.0 * _STEP) for step in _STEP * np.eye(2)],
            axis=2,
        )
        changes = np.stack(on_plane, axis=2)
        seen = np.isfinite(changes).all(axis=(1, 2)) & np.isfinite(by_point).all(axis=(1, 2))
        changes[~seen], by_point[~seen] = 0.0, np.eye(2)
        scale = np.array([cameras[k].scale for k in images])[:, None, None]
        in_image = np.linalg.solve(by_point, changes).reshape(len(images), -1, changes.shape[2]) * scale
        products.append(np.swapaxes(in_image, 1, 2) @ in_image)
        points.append(seen.reshape(len(images), -1).sum(axis=1))
    every_product = np.concatenate(products)
    total, first = every_product.sum(axis=0), len(sizes)
    known = np.linalg.lstsq(total[first:, first:], total[first:, :first], rcond=None)[0]
    without_frame = np.concatenate([np.eye(first), -known])
    return np.asarray(
        without_frame.T @ every_product @ without_frame / np.maximum(np.concatenate(points), 1)[:, None, None]
    )


def _cause(effects: Sequence[Effect], sizes: FloatArray, covariance: FloatArray) -> str:
    """The kind of effects that is farthest from nothing."""
    causes = [effect.cause for effect in effects]

    def significance(cause: str) -> float:
        indices = [k for k, each in enumerate(causes) if each == cause]
        return float(sizes[indices] @ inverse_information(covariance[np.ix_(indices, indices)]) @ sizes[indices]) / len(
            indices
        )

    return max(dict.fromkeys(causes), key=significance)
