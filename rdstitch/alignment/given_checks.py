"""Whether given attitudes, a given tilt or a given focal length are those that the images show.

The images are aligned without them, and show the tilt of each up to a covariance. Attitudes that need more scatter
than they are said to have are compared with the same angles of other signs and in the other order, and with none at
all, each with the scatter that makes it most likely. A given tilt is compared with the one that all show, too. A focal
length that gives way to the images is compared with the one that they show by themselves.
"""

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from rdstitch.alignment import sentences
from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.alignment_options import AlignmentOptions
from rdstitch.alignment.delays import at_delay, smooth
from rdstitch.alignment.least_squares.priors import CameraPriors
from rdstitch.alignment.motion_models import MODELS, POSE, PSI, THETA
from rdstitch.alignment.select import select_model
from rdstitch.alignment.starts import start_from
from rdstitch.arrays import FloatArray, IntArray, evenly_spaced
from rdstitch.choices import ModelName
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.delays import DELAY_STD, DELAYS
from rdstitch.results.messages import Message
from rdstitch.robust.priors import WRONG_GIVEN_FOCAL

_MAX_IMAGES = 60  # that are compared: evenly chosen ones of more say as well which signs are right
_LOG_ODDS = math.log(1000.0)  # by how much the images must contradict what the user says
_SCATTERS = np.append(0.0, np.radians(np.geomspace(0.01, 45.0, 60)))  # standard deviations that are tried
_CENTER_STD = 0.03  # half diagonals, of the distortion centre: as in LENS_PRIORS
_EXACT = math.radians(0.01)  # nothing is mounted more exactly
_STRAINED = 2.0  # standard deviations of a given focal length by which it must have given way to be looked at again

_WITH_TILTS: list[ModelName] = ["tilting"]

LATE = 3.0
"""Standard deviations from which on a delay is one."""

_FREE_MOUNT = 1.0  # standard deviation, radians, of a tilt of the mount of which nothing is known

_SIGNED_ORDERS = tuple(
    np.diag(signs)[:, list(order)] for order in ((0, 1), (1, 0)) for signs in product((1.0, -1.0), repeat=2)
)
"""Matrices (2, 2) that change signs and order of (ψ, θ); the first changes nothing."""


def check_attitudes(problem: Problem, options: AlignmentOptions) -> tuple[AlignmentOptions, list[Message]]:
    """Options without what the images contradict, or with the scatter or delay that they show; and what changed.

    Nothing where nothing is given, or the images agree with it as well as it is said to be known, or show no tilts.
    """
    if options.attitudes is None and options.tilt is None:
        return options, []
    fitted = _fit_without_tilts(problem, options)
    if fitted is None:
        return options, []
    priors, messages = problem.camera_priors, list[Message]()
    shown, attitudes, delayed = _ShownTilts.of(*fitted, options), priors.attitudes, priors.delayed_attitudes
    if delayed is not None and (late := shown.delay(delayed + priors.tilt)) is not None:
        attitudes, of_all = (at_delay(np.asarray(values), late[0]) for values in (delayed, options.delayed_attitudes))
        options = replace(options, attitudes=of_all, delayed_attitudes=None)
        messages.append(sentences.attitudes_late(*late))
    if (contradiction := _contradiction(shown, attitudes + priors.tilt, options)) is not None:
        options, message = contradiction
        messages.append(message)
    return options, messages


def _without_tilts(options: AlignmentOptions) -> AlignmentOptions:
    return replace(options, attitudes=None, delayed_attitudes=None, tilt=None)


def _contradiction(
    shown: "_ShownTilts", given: FloatArray, options: AlignmentOptions
) -> tuple[AlignmentOptions, Message] | None:
    """What replaces the options where the images contradict the given tilts (N, 2), radians, or their accuracy."""
    stated = options.attitudes_std if options.attitudes is not None else 0.0
    # The largest log likelihood and its scatter of tilts as given, with other signs or order, and of none.
    changed = [shown.best_scatter(given @ change.T) for change in _SIGNED_ORDERS]
    (as_given, scatter), likeliest = changed[0], max(range(len(changed)), key=lambda k: changed[k][0])
    (as_changed, scatter_changed), (without_any, _) = changed[likeliest], shown.best_scatter(np.zeros_like(given))
    common = np.median(shown.tilts, axis=0)
    if options.attitudes is None:  # against the one that all show, unless the distortion centre explains the difference
        as_shown, _ = shown.best_scatter(np.broadcast_to(common, given.shape))
        by_center = as_shown - 0.5 * float((((common - given[0]) / shown.center_std) ** 2).sum())
        if as_shown >= max(as_given, by_center) + _LOG_ODDS:
            return _without_tilts(options), sentences.tilt_contradicted(given[0], common)
    if as_given - shown.log_likelihood(given, stated) < _LOG_ODDS or scatter <= stated:
        return None
    if max(as_changed, without_any) >= as_given + _LOG_ODDS:
        if options.attitudes is None:
            return _without_tilts(options), sentences.tilt_contradicted(given[0], common)
        change = _SIGNED_ORDERS[likeliest] if as_changed > without_any + _LOG_ODDS else None
        return _without_tilts(options), sentences.attitudes_contradicted(scatter, change, max(scatter_changed, _EXACT))
    if options.attitudes is None:
        return None
    return replace(options, attitudes_std=scatter), sentences.attitudes_scatter(scatter, stated)


def _fit_without_tilts(problem: Problem, options: AlignmentOptions) -> tuple[Problem, Fit] | None:
    """The problem that knows nothing of the tilts, and a fit with the tilts that it shows; None where it shows none."""
    priors = problem.camera_priors
    nothing = replace(
        priors, attitudes=np.zeros_like(priors.attitudes), attitudes_std=None, tilt=(0.0, 0.0), tilt_known=False
    )
    bare = replace(problem, camera_priors=nothing)
    models = [name for name in _without_tilts(options).models if not MODELS[name].on_sphere]
    # A model of one tilt shows no others.
    models = models if options.model == "auto" or options.attitudes is None else _WITH_TILTS
    fit = select_model(bare, models).fit if models else None
    if fit is None or not fit.model.has_metric_poses:
        return None
    if fit.model.free_tilts and not fit.model.any_tilt:  # whose prior draws tilts together
        fit = bare.refine(POSE, start_from(bare, POSE, fit))
    return bare, fit


def is_strained(priors: CameraPriors, fit: Fit) -> bool:
    """Whether a focal length that the user gave gave way to the images by more than is likely."""
    if priors.focal_source not in ("option", "file") or not fit.model.has_metric_poses:
        return False
    moved = fit.model.log_focal(fit.result.parameters.shared) - priors.log_focal
    return abs(moved) > _STRAINED * priors.log_focal_std


def check_focal(given: Camera, fit: Fit, covariance: FloatArray | None) -> Message | None:
    """What the user should know of a focal length that was given, by a fit without it; None where that agrees."""
    if not fit.model.has_metric_poses or covariance is None or given.focal is None:
        return None
    place = fit.model.shared_names.index("log_focal")
    focal, std = fit.model.focal(fit.result.parameters.shared) * given.scale, math.sqrt(covariance[place, place])
    _, contradicted = judged_focal(given.focal_log_std, math.log(focal / given.focal), std)
    return sentences.focal_contradicted(given.focal, focal, std) if contradicted else None


def judged_focal(stated_std: float, shown: float, shown_std: float) -> tuple[float, bool]:
    """Root mean square error of the logarithm of a given focal length, and whether the images contradict it.

    It is right within ``stated_std``, or wrong by anything (:data:`WRONG_GIVEN_FOCAL`); the images show one that is
    ``shown`` longer, as a logarithm, with a standard deviation that is inf where they show none.
    """
    prior_wrong, far = WRONG_GIVEN_FOCAL
    logs, squares = [], []
    for weight, std in ((1.0 - prior_wrong, stated_std), (prior_wrong, far)):
        spread = std**2 + shown_std**2
        gain = std**2 / spread if math.isfinite(spread) else 0.0
        logs.append(math.log(weight) - (0.5 * (math.log(spread) + shown**2 / spread) if gain else 0.0))
        squares.append((gain * shown) ** 2 + (1.0 - gain) * std**2)
    log_odds = logs[1] - logs[0]
    wrong = 1.0 / (1.0 + math.exp(min(-log_odds, 700.0)))
    return math.sqrt((1.0 - wrong) * squares[0] + wrong * squares[1]), log_odds > _LOG_ODDS


@dataclass(frozen=True, eq=False)
class _ShownTilts:
    """What the images show of their tilts."""

    images: IntArray  # (K,): the images compared
    tilts: FloatArray  # (K, 2): (ψ, θ), radians
    center_std: float  # of a tilt, radians, by what is not known of the distortion centre
    variances: FloatArray  # variances, axes: (2 K,) and (2 K, 2 K): eigenvalues and eigenvectors of their covariance
    axes: FloatArray

    @classmethod
    def of(cls, problem: Problem, fit: Fit, options: AlignmentOptions) -> "_ShownTilts":
        """Take the tilts from a planar fit that knows nothing of them; up to what all share where no tilt is given."""
        adjuster, adjusted, model = problem.adjuster_of(fit), fit.result, fit.model
        normal = adjuster.normal_equations(adjusted)
        tilts = model.metric_poses(adjusted.parameters.poses, adjusted.parameters.shared)[:, [PSI, THETA]]
        images = evenly_spaced(problem.count, _MAX_IMAGES)
        focal = model.focal(adjusted.parameters.shared)
        rows = np.arange(2 * len(images))
        by_pose = np.zeros((*normal.gradient_poses.shape, len(rows)))
        by_shared = np.zeros((len(normal.gradient_shared), len(rows)))
        for axis, column in enumerate((PSI, THETA)):
            if column in model.free:
                by_pose[images, model.free.index(column), rows[axis::2]] = focal
            by_shared[axis, rows[axis::2]] = focal
        by_shared[len(model.shared_names) - 1] = tilts[images].ravel()
        moved_poses, moved_shared = normal.responses(-by_pose, -by_shared)
        covariance = np.einsum("ndb,ndc->bc", by_pose, moved_poses, optimize=True) + by_shared.T @ moved_shared
        if options.tilt is None:
            covariance = covariance + _FREE_MOUNT**2 * np.tile(np.eye(2), (len(images), len(images)))
        variances, axes = np.linalg.eigh((covariance + covariance.T) / 2.0)
        return cls(images, tilts[images], _CENTER_STD / focal, np.maximum(variances, 0.0), axes)

    def log_likelihood(self, expected: FloatArray, scatter: float) -> float:
        """Log-likelihood of tilts (N, 2) that scatter by so much, radians, about those of the images."""
        error = self.axes.T @ (self.tilts - expected[self.images]).ravel()
        variance = self.variances + scatter**2 + _EXACT**2
        return -0.5 * float((error**2 / variance + np.log(variance)).sum())

    def best_scatter(self, expected: FloatArray) -> tuple[float, float]:
        """The largest log likelihood of tilts (N, 2), and the scatter that it has."""
        values = [self.log_likelihood(expected, scatter) for scatter in _SCATTERS.tolist()]
        best = int(np.argmax(values))
        return values[best], float(_SCATTERS[best])

    def delay(self, expected: FloatArray) -> tuple[float, float] | None:
        """Delay of the times of tilts (N, S, 2) at :data:`DELAYS`, s, with its standard deviation; or None."""
        slow = smooth(expected)
        scores = (
            np.array([self.best_scatter(slow[:, k])[0] for k in range(len(DELAYS))]) - (DELAYS / DELAY_STD) ** 2 / 2
        )
        best, step = int(np.argmax(scores)), float(DELAYS[1] - DELAYS[0])
        if best in (0, len(DELAYS) - 1):
            return None
        below, top, above = scores[best - 1 : best + 2].tolist()
        curvature = 2.0 * top - below - above
        delay, std = float(DELAYS[best]) + step * (above - below) / (2.0 * curvature), step / math.sqrt(curvature)
        return (delay, std) if abs(delay) > LATE * std else None
