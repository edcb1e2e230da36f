"""One connected set of images, the priors of its camera, and the adjustment of one model to it."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rdstitch.alignment.least_squares.bundle_adjustment import (
    MIN_GAIN,
    ROUGH_GAIN,
    WIDEST_START,
    BundleAdjuster,
    BundleAdjustmentResult,
    FreeParameters,
    Parameters,
)
from rdstitch.alignment.least_squares.link_equations import split_lens, squared_lengths, whitened_errors
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.priors import CameraPriors
from rdstitch.alignment.metric_upgrade import metric_upgrade
from rdstitch.alignment.motion_models import HOMOGRAPHY, PSI, SIMILARITY, THETA, MotionModel, PlanarModel
from rdstitch.alignment.noise import shared_variance
from rdstitch.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from rdstitch.geometry.division_model import undistort
from rdstitch.geometry.radial_homography import RadialHomography, inverses, transfer
from rdstitch.matching.match_graph import connected_components, spanning_tree
from rdstitch.robust.loss import ALIGNMENT_WIDTH, robust_cost, sigma_of
from rdstitch.solvers.homography import direct_linear

MAX_ITERATIONS = 24
"""A start need not be the minimum."""


def relations_at(observations: Observations, relations: Sequence[RadialHomography], lens: FloatArray) -> FloatArray:
    """Each link's homography (L, 3, 3) expressed with one common lens.

    A pair's homography belongs to the pair's own λ. Where that differs from the common one, the homography is fitted
    anew (DLT) to the pair's own, outlier-free transfer of its points.
    """
    distortion, higher, center = split_lens(lens)
    result = np.empty((len(relations), 3, 3))
    for link, relation in enumerate(relations):
        result[link] = relation.homography
        if abs(relation.distortion - distortion) < 1e-9 and not center.any() and relation.camera.higher == higher:
            continue
        points1 = observations.points1[observations.start[link] : observations.start[link + 1]]
        transferred = transfer(relation.homography, relation.distortion, points1, relation.camera.higher)
        x1, x2 = (undistort(points - center, distortion, higher) for points in (points1, transferred))
        valid = np.isfinite(x1).all(axis=1) & np.isfinite(x2).all(axis=1)
        if valid.sum() >= 4:
            result[link] = direct_linear(x1[valid], x2[valid])
    return result


def independent_pairs(
    model: MotionModel,
    observations: Observations,
    homographies: FloatArray,
    shared: FloatArray,
    lens: FloatArray,
    free_lens: BoolArray,
    known: CameraPriors,
) -> tuple[BundleAdjuster, Parameters]:
    """Return the adjustment of every link on its own, with the shared parameters in common, and where it starts.

    Of the links' homographies (L, 3, 3) at this lens. Of what is known of the camera, attitudes are taken as exact, and
    nothing of the poses besides.
    """
    count = 2 * len(observations)
    start = Parameters(nearest_pairs(model, observations, homographies, shared, known.attitudes), shared, lens)
    freedom = FreeParameters.fixing(model, count, list(range(0, count, 2)), free_lens)
    first = 2 * np.arange(len(observations))
    apart = replace(observations, image1=first, image2=first + 1)
    return BundleAdjuster(model, apart, freedom, known.of_camera(model, count), max_iterations=MAX_ITERATIONS), start


def nearest_pairs(
    model: MotionModel, observations: Observations, homographies: FloatArray, shared: FloatArray, attitudes: FloatArray
) -> FloatArray:
    """Poses of both images of every link, (2 L, ...), nearest to its homography (L, 3, 3); the first at the origin."""
    tilts = attitudes[np.stack([observations.image1, observations.image2], axis=1)].reshape(-1, 2)
    matrices = model.nominal_homographies(shared, tilts)
    matrices[1::2] = homographies @ matrices[0::2]
    return model.nearest_poses(matrices, shared, tilts)


_LONG_CHAIN = 60
"""Images over which chained homographies drift so far that a planar model is the better start."""

_TRIAL_LINKS, _TRIAL_MATCHES = 30, 40
"""What the shared parameters to start from are tried on."""

POSE_TILT_SPREAD = math.radians(35.0)
"""Of images of which nothing is known: half of the tilts lie below 40 degrees."""

_TILT_SPREAD_START = math.radians(3.0)
_MIN_TILT_SPREAD = math.radians(0.05)
_ROUNDS, _SETTLED = 3, 0.1
"""Of estimating scales of priors, and by how much they still change at the end."""

_MISFIT = 1.5
"""Times the errors of links on their own from which on those of a model are its own."""


@dataclass(frozen=True, eq=False)
class Fit:
    """One model adjusted to a problem."""

    model: MotionModel
    adjusted: BundleAdjustmentResult
    free_lens: BoolArray  # (5,): lens parameters that were estimated
    tilt_spread: float = 0.0  # standard deviation of the images' own tilts, radians; 0 where the model has none
    # of the errors that it leaves, at least that of the problem; see BundleAdjuster
    overdispersion: float = 1.0


@dataclass(frozen=True, eq=False)
class Problem:
    """Connected images to be aligned."""

    observations: Observations  # links between the images 0 … N-1
    homographies: FloatArray  # (L, 3, 3): of the links, at the ``lens``
    trust: FloatArray  # (L,): how much each link can be relied on to start with
    count: int  # N
    fixed: int | None  # the image that fixes the gauge; None: part chooses one
    lens: FloatArray  # (5,): where to start
    free_lens: BoolArray  # (5,)
    camera_priors: CameraPriors
    overdispersion: float = 1.0  # overdispersion, min_gain: see BundleAdjuster
    min_gain: float = MIN_GAIN

    @property
    def reference(self) -> int:
        """The image that fixes the gauge, of a part."""
        assert self.fixed is not None, "only a part of a problem has a reference"
        return self.fixed

    def part(self, kept: BoolArray, images: IntArray | None = None) -> tuple["Problem", IntArray]:
        """The problem of some links (L,) between these images, or the largest group that they connect; and the images.

        Without a reference among them the centre of their match graph is it.
        """
        o = self.observations
        if images is None:
            images = np.array(connected_components(self.count, o.image1[kept], o.image2[kept])[0], dtype=np.intp)
        number = np.full(self.count, -1, dtype=np.intp)
        number[images] = np.arange(len(images))
        links = np.flatnonzero(kept & (number[o.image1] >= 0) & (number[o.image2] >= 0))
        observations = o.subset(links, number)
        reference = -1 if self.fixed is None else int(number[self.fixed])
        if reference < 0:
            reference = spanning_tree(len(images), observations.image1, observations.image2, self.trust[links]).root
        part = replace(
            self,
            observations=observations,
            homographies=self.homographies[links],
            trust=self.trust[links],
            count=len(images),
            fixed=reference,
            camera_priors=self.camera_priors.of(images),
        )
        return part, images

    def fit(self, model: MotionModel, others: Sequence[Fit] = (), shared: FloatArray | None = None) -> Fit:
        """Adjust a model from the chained links or from the solution of a less free model, whichever is nearer.

        The links start from ``shared`` parameters where these are known, otherwise from the best of several.
        """
        if not others and not model.one_camera and self.count > _LONG_CHAIN:
            others = [self.fit(SIMILARITY)]
        starts = [self.start_from(model, other) for other in others]
        if model.any_tilt:
            starts.append(self._upgraded(model))
        elif not (others and model.free_tilts):
            starts.append(self._chained(model, others, shared))
        return self.refine(model, self._nearest(model, starts))

    def squared(self, model: MotionModel, parameters: Parameters) -> FloatArray:
        """``|r|²`` of each correspondence (M,) at some parameters, px², whitened."""
        return self.adjuster(model).squared(parameters)

    def refine(self, model: MotionModel, start: Parameters, tilt_spread: float | None = None) -> Fit:
        """Adjust a model from a given start, with the scales of its priors: the tilts' spread, the errors' dependence.

        What neighbours share in the errors belongs to the model: where that is large, priors count for more.
        """
        measured = self.camera_priors.attitudes_std
        estimated = model.free_tilts and not model.any_tilt and measured is None
        if estimated:
            spread = tilt_spread or _TILT_SPREAD_START
        else:
            spread = POSE_TILT_SPREAD if model.any_tilt and measured is None else measured or 0.0
        overdispersion = self.overdispersion
        adjusted = self.adjuster(model, spread, start.shared).run(start, rough=True)
        for rounds in itertools.count(1):
            # Attitudes are divided by the focal length.
            again = model.free_tilts and measured is not None and rounds == 1
            if estimated and rounds <= _ROUNDS:
                tilts = adjusted.parameters.poses[:, [PSI, THETA]] * model.focal(adjusted.parameters.shared)
                former, spread = spread, max(float(np.sqrt(np.mean(tilts**2))), _MIN_TILT_SPREAD)
                again = abs(spread - former) > _SETTLED * former
            if not again and overdispersion == self.overdispersion and adjusted.sigma > _MISFIT * self._link_sigma:
                shared = shared_variance(self.observations, adjusted.errors, adjusted.inliers)
                overdispersion = max(overdispersion, shared)
                again = overdispersion > self.overdispersion
            if not again:
                break
            at = adjusted.parameters
            adjusted = self.adjuster(model, spread, at.shared, overdispersion).run(at, rough=True)
        return Fit(model, adjusted, self.free_lens, spread if model.free_tilts else 0.0, overdispersion)

    @cached_property
    def _link_sigma(self) -> float:
        """Standard deviation of a coordinate of the errors of links on their own, pixels."""
        squared = squared_lengths(whitened_errors(self.observations, self.homographies, self.lens))
        return self.observations.sigma(squared)

    def extend(self, fit: Fit, lens: BoolArray) -> Fit:
        """The same model with more of the lens free."""
        wider = replace(self, free_lens=self.free_lens | lens)
        return wider.refine(fit.model, fit.adjusted.parameters, fit.tilt_spread)

    def adjuster_of(self, fit: Fit) -> BundleAdjuster:
        """Of a fit, with the priors on it."""
        return self.adjuster(fit.model, fit.tilt_spread or 1.0, fit.adjusted.parameters.shared, fit.overdispersion)

    def adjuster(
        self,
        model: MotionModel,
        tilt_spread: float = _TILT_SPREAD_START,
        shared: FloatArray | None = None,
        overdispersion: float | None = None,
    ) -> BundleAdjuster:
        """Of one model, with the priors on it; those of tilts as they show with the ``shared`` parameters."""
        references = [self.reference] if self.camera_priors.fix_frame else []
        freedom = FreeParameters.fixing(model, self.count, references, self.free_lens)
        log_focal = None if shared is None or not len(shared) else float(shared[-1])
        priors = self.camera_priors.priors(model, self.count, tilt_spread, log_focal)
        overdispersion = overdispersion or self.overdispersion
        return BundleAdjuster(model, self.observations, freedom, priors, overdispersion, min_gain=self.min_gain)

    def _chained(self, model: MotionModel, others: Sequence[Fit], start: FloatArray | None) -> Parameters:
        """Every link on its own, chained along the tree of the links trusted most."""
        o, attitudes = self.observations, self.camera_priors.attitudes
        shared, homographies = np.zeros(0), self.homographies
        if model.one_camera:
            shared, homographies = self._one_camera_links(SIMILARITY if model.free_tilts else model, others, start)
        tree = spanning_tree(self.count, o.image1, o.image2, self.trust, self.reference)
        origin = model.nominal_homographies(shared, attitudes[[tree.root]])[0]
        chained = tree.chained(homographies, o.image1, origin)
        return Parameters(model.nearest_poses(chained, shared, attitudes), shared, self.lens)

    def _upgraded(self, model: MotionModel) -> Parameters:
        """Chained homographies with the metric of the plane that makes them images of one camera."""
        o, prior = self.observations, self.camera_priors
        tree = spanning_tree(self.count, o.image1, o.image2, self.trust, self.reference)
        chained = tree.chained(self.homographies, o.image1, np.eye(3))
        upgraded = metric_upgrade(chained, tree.root, prior.log_focal, prior.log_focal_std)
        shared = model.shared_from_physical(np.array([*upgraded.tilt, upgraded.log_focal]))
        return Parameters(upgraded.poses, shared, self.lens)

    def _one_camera_links(
        self, model: MotionModel, others: Sequence[Fit], shared: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Shared parameters, and with these the homographies (L, 3, 3) under one camera that are nearest to the links.

        The parameters are those given, those of another planar model, or the best of several.
        """
        planar = [other for other in others if other.model.one_camera]
        if shared is None and planar:
            shared = planar[-1].adjusted.parameters.shared
        elif shared is None:
            adjuster, at = self._best_trial(model)
            shared = (at if len(self.observations) == 1 else adjuster.run(at).parameters).shared
        poses = nearest_pairs(model, self.observations, self.homographies, shared, self.camera_priors.attitudes)
        matrices = model.matrices(poses, shared).matrices
        return shared, matrices[1::2] @ inverses(matrices[0::2])

    def trial(self, model: MotionModel) -> BundleAdjustmentResult:
        """A few links on their own under one camera."""
        adjuster, start = self._best_trial(model)
        return adjuster.run(start)

    def pairwise(self, model: MotionModel, trial: BundleAdjustmentResult) -> BundleAdjustmentResult:
        """All links on their own under one camera, which starts as a trial has it."""
        o, homographies, shared = self.observations, self.homographies, trial.parameters.shared
        adjuster, start = independent_pairs(
            model, o, homographies, shared, self.lens, self.free_lens, self.camera_priors
        )
        return replace(adjuster, min_gain=self.min_gain).run(start)

    def _best_trial(self, model: MotionModel) -> tuple[BundleAdjuster, Parameters]:
        """Of a few links on their own, from the shared parameters that come nearest to them without adjustment."""
        known, links = self.camera_priors, len(self.observations)
        few = evenly_spaced(links, _TRIAL_LINKS)
        sample, homographies = self.observations.subset(few).thinned(_TRIAL_MATCHES), self.homographies[few]
        trials = [
            independent_pairs(model, sample, homographies, shared, self.lens, self.free_lens, known)
            for shared in model.shared_starts(known.log_focal, known.tilt, tilt_known=known.tilt_known)
        ]
        squared = [adjuster.squared(start) for adjuster, start in trials]
        width = ALIGNMENT_WIDTH * min(float(np.median(sample.scale2)), *map(sigma_of, squared))
        adjuster, start = trials[int(np.argmin([robust_cost(each, width).sum() for each in squared]))]
        return replace(adjuster, min_gain=ROUGH_GAIN), start

    def start_from(self, model: MotionModel, other: Fit) -> Parameters:
        """Another model's solution as this model's start."""
        parameters = other.adjusted.parameters
        if isinstance(model, PlanarModel) and isinstance(other.model, PlanarModel):
            return replace(parameters, poses=model.start_from(other.model, parameters.poses, parameters.shared))
        shared = parameters.shared if model.one_camera else np.empty(0)
        poses = model.nearest_poses(other.adjusted.matrices.matrices, shared, self.camera_priors.attitudes)
        return Parameters(poses, shared, parameters.lens)

    def _nearest(self, model: MotionModel, starts: Sequence[Parameters]) -> Parameters:
        """The start with the smallest errors, those far away counting alike."""
        if len(starts) == 1:
            return starts[0]
        adjuster = self.adjuster(model)
        width = WIDEST_START * float(np.median(self.observations.scale2))
        return min(starts, key=lambda start: float(robust_cost(adjuster.squared(start), width).sum()))


def pairwise_homographies(
    observations: Observations, homographies: FloatArray, lens: FloatArray, free_lens: BoolArray, known: CameraPriors
) -> BundleAdjustmentResult:
    """Every link on its own with a homography: what is wrong with a link shows nowhere else."""
    adjuster, at = independent_pairs(HOMOGRAPHY, observations, homographies, np.empty(0), lens, free_lens, known)
    return adjuster.run(at)


def thin_for_selection(links: int) -> int:
    """Correspondences per link that suffice to choose a model: fewer where there are many links."""
    return int(np.clip(5_000 // max(links, 1), 40, 150))
