"""Ways to change the whole of an alignment a little, and how far the images move with each.

The ways are the parameters that all images share, and effects that are not modelled
(:mod:`rdstitch.alignment.unmodelled`). The poses follow each of them, so that the overlaps go on agreeing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.bundle_adjustment import BundleAdjuster, Parameters
from rdstitch.alignment.lens_selection import CENTER
from rdstitch.alignment.link_equations import whitened_errors
from rdstitch.alignment.motion_models import inverses
from rdstitch.alignment.noise_model import EXACTNESS
from rdstitch.alignment.observations import Observations
from rdstitch.alignment.unmodelled import Effect, mapped
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.camera import Camera
from rdstitch.division_model import distort, undistort
from rdstitch.late_imports import linalg
from rdstitch.robust.loss import ALIGNMENT_WIDTH

_STEP = 1e-4
"""Of differences by an effect's size, in units of its own."""

_SIDE = 6
"""Points along a side of each image whose places are compared."""

_ENOUGH, _MIN_MATCHES_PER_LINK = 6000, 8
"""Correspondences in all, and of each link at least, that say what the shape is."""

_NO_ROBUSTNESS = 1e9
"""Pixels: a width of the loss at which it is the square."""

_SMALL = 1e-3
"""Standard deviations of a parameter by which it is moved for a difference."""


@dataclass(frozen=True)
class Directions:
    """One way for each shared parameter and each effect.

    Attributes
    ----------
    adjuster : BundleAdjuster
        Of the inliers.
    fit : Fit
    effects : sequence of Effect
    response : ndarray of shape (F, S)
        How the free pose parameters follow a unit step of each.
    size : ndarray of shape (S,)
        A small step of each.
    """

    adjuster: BundleAdjuster
    fit: Fit
    effects: Sequence[Effect]
    response: FloatArray
    size: FloatArray

    @classmethod
    def of(cls, problem: Problem, fit: Fit, effects: Sequence[Effect]) -> Self:
        """From the normal equations, with the effects as more shared parameters."""
        noise = math.hypot(fit.adjusted.sigma, EXACTNESS)
        at = replace(fit.adjusted, sigma=noise)
        adjuster = problem.adjuster_of(fit)
        adjuster = replace(adjuster, observations=_inliers(adjuster, fit))
        normal = adjuster.normal_equations(at, _NO_ROBUSTNESS)
        coupling = [normal.coupling]
        for effect in effects:
            # Central differences: poses take up most of an effect; what is left is a small difference of large sums.
            ahead, behind = (
                replace(adjuster, observations=_corrected(adjuster.observations, effect, size)).normal_equations(
                    at, _NO_ROBUSTNESS
                )
                for size in (_STEP, -_STEP)
            )
            coupling.append(((ahead.gradient_poses - behind.gradient_poses) / (2.0 * _STEP))[:, None])
        both = np.hstack(coupling)
        response = replace(normal, coupling=both, shared=np.zeros((both.shape[1],) * 2)).pose_response()
        known = np.sqrt(np.maximum(np.diag(normal.shared), 1e-12))
        size = np.concatenate([_SMALL / known, np.full(len(effects), _STEP)])
        return cls(adjuster, fit, effects, response, size)

    def moved(self, index: int, size: float) -> tuple[Parameters, Effect | None]:
        """The parameters after a step in one direction, and the effect that comes with it."""
        kept = self.response.shape[1] - len(self.effects)
        poses, shared = np.zeros(self.adjuster.free.poses.shape), np.zeros(kept)
        poses[self.adjuster.free.poses] = self.response[:, index] * size
        shared[index : index + 1] = size  # an effect is none of the model's parameters
        parameters = self.fit.adjusted.parameters.retract(self.fit.model, poses, shared, self.adjuster.free.lens)
        return parameters, None if index < kept else self.effects[index - kept]

    def errors(self, index: int, size: float) -> FloatArray:
        """Whitened errors (M, 2) after a step, pixels; 0 where there is none."""
        parameters, effect = self.moved(index, size)
        observations = self.adjuster.observations
        if effect is not None:
            observations = _corrected(observations, effect, size)
        matrices = self.fit.model.matrices(parameters.poses, parameters.shared).matrices
        homographies = matrices[observations.image2] @ inverses(matrices)[observations.image1]
        return np.nan_to_num(whitened_errors(observations, homographies, parameters.lens))

    def information(self) -> tuple[FloatArray, FloatArray]:
        """Information (S, S) on the steps, and the gradient (S,) of half the cost."""
        noise = math.hypot(self.fit.adjusted.sigma, EXACTNESS)
        weight, priors = self.adjuster.weight(noise), self.adjuster.priors
        columns = [
            (self.errors(k, size) - self.errors(k, -size)).ravel() / (2.0 * size)
            for k, size in enumerate(self.size.tolist())
        ]
        by_step = np.stack(columns, axis=1)
        errors = self.errors(0, 0.0).ravel()
        free = self.adjuster.free.poses
        precision = priors.poses_precision[free]
        offset = (self.fit.model.prior_coordinates(self.fit.adjusted.parameters.poses) - priors.poses)[free]
        gradient = weight * by_step.T @ errors + self.response.T @ (precision * offset)
        information = weight * by_step.T @ by_step + self.response.T @ (precision[:, None] * self.response)
        return information + self._priors(), gradient

    def _priors(self) -> FloatArray:
        """Information (S, S) before anything is measured."""
        parameters = self.fit.adjusted.parameters
        derivative = self.adjuster.named_parameters(parameters.shared)[1]
        camera = derivative.T @ (self.adjuster.prior_curvatures(parameters)[:, None] * derivative)
        effects = np.diag([effect.std**-2.0 for effect in self.effects])
        return np.asarray(linalg.block_diag(camera, effects), dtype=np.float64)


def places(found: Directions, cameras: Sequence[Camera], count: int) -> tuple[FloatArray, IntArray]:
    """How far points of the images move in them with a step in each of the first directions, and their images.

    Returns
    -------
    places : ndarray of shape (P, 2, count)
        Pixels, without what one homography of the whole does.
    images : ndarray of shape (P,), intp
    """
    grid = np.stack(np.meshgrid(np.linspace(0.0, 1.0, _SIDE), np.linspace(0.0, 1.0, _SIDE)), -1).reshape(-1, 2)
    points = np.concatenate([camera.normalize(grid * (np.array(camera.image_size) - 1.0)) for camera in cameras])
    images = np.repeat(np.arange(len(cameras)), len(grid))
    here = _Ground.of(found.fit, found.fit.adjusted.parameters, images)
    ground = here.of_points(points)
    columns = []
    for index, size in enumerate(found.size[:count].tolist()):
        parameters, effect = found.moved(index, size)
        measured = points if effect is None else effect.correct(points, images, size)
        columns.append((_Ground.of(found.fit, parameters, images).of_points(measured) - ground) / size)
    flat = (ground - np.nanmean(ground, axis=0)) / max(float(np.nanstd(ground)), 1e-12)
    frame = [np.outer(own, unit).reshape(-1, 2) for own in (np.ones(len(flat)), *flat.T) for unit in np.eye(2)]
    frame += [flat * flat[:, [axis]] for axis in (0, 1)]
    by_ground = here.by_ground(ground) * np.array([camera.scale for camera in cameras])[images, None, None]
    moved, by_frame = (np.einsum("pab,pbs->pas", by_ground, np.stack(each, axis=2)) for each in (columns, frame))
    seen = np.isfinite(moved).all(axis=(1, 2)) & np.isfinite(by_frame).all(axis=(1, 2))
    moved, by_frame = moved[seen], by_frame[seen]
    known = np.linalg.lstsq(by_frame.reshape(-1, len(frame)), moved.reshape(-1, len(columns)), rcond=None)[0]
    return moved - np.einsum("pak,ks->pas", by_frame, known), images[seen]


def _inliers(adjuster: BundleAdjuster, fit: Fit) -> Observations:
    """As many observations as say what the shape is, without those that the fit does not explain."""
    few = adjuster.observations.thinned(max(_ENOUGH // max(len(adjuster.observations), 1), _MIN_MATCHES_PER_LINK))
    squared = replace(adjuster, observations=few).squared(fit.adjusted.parameters)
    kept = squared <= (ALIGNMENT_WIDTH * fit.adjusted.sigma) ** 2
    before = np.concatenate([[0], np.cumsum(kept)])
    return replace(few, start=before[few.start], points1=few.points1[kept], points2=few.points2[kept])


def _corrected(observations: Observations, effect: Effect, size: float) -> Observations:
    """The observations as they would be without an effect of some size."""
    link = observations.link
    return replace(
        observations,
        points1=effect.correct(observations.points1, observations.image1[link], size),
        points2=effect.correct(observations.points2, observations.image2[link], size),
    )


@dataclass(frozen=True)
class _Ground:
    """Where the points of images lie on the plane, with some parameters."""

    to_image: FloatArray
    lens: FloatArray

    @classmethod
    def of(cls, fit: Fit, parameters: Parameters, images: IntArray) -> Self:
        """For points of these images (P,)."""
        return cls(fit.model.matrices(parameters.poses, parameters.shared).matrices[images], parameters.lens)

    def of_points(self, points: FloatArray) -> FloatArray:
        """Of measured points (P, 2), half diagonals; NaN beyond the horizon."""
        flat = undistort(points - self.lens[CENTER], float(self.lens[0]), tuple(self.lens[1:3].tolist()))
        return mapped(inverses(self.to_image), flat)

    def by_ground(self, ground: FloatArray) -> FloatArray:
        """Derivatives (P, 2, 2) of measured points, half diagonals, by places on the plane (P, 2)."""
        size = _SMALL * max(float(np.nanstd(ground)), 1e-12)
        ends = [[self._measured(ground + sign * size * np.eye(2)[axis]) for sign in (1.0, -1.0)] for axis in (0, 1)]
        return np.stack([(ahead - behind) / (2.0 * size) for ahead, behind in ends], axis=2)

    def _measured(self, ground: FloatArray) -> FloatArray:
        return distort(mapped(self.to_image, ground), float(self.lens[0]), tuple(self.lens[1:3].tolist()))
