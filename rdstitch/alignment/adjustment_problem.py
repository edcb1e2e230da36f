"""One connected set of images, the priors of its camera, and the adjustment of one model to it from a given start."""

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rdstitch.alignment.least_squares.bundle_adjustment import (
    MIN_GAIN,
    BundleAdjuster,
    BundleAdjustmentResult,
    FreeParameters,
    Parameters,
)
from rdstitch.alignment.least_squares.link_equations import squared_lengths, whitened_errors
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.priors import CameraPriors
from rdstitch.alignment.motion_models import PSI, THETA, MotionModel
from rdstitch.alignment.noise import shared_variance
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.matching.match_graph import connected_components, spanning_tree

POSE_TILT_SPREAD = math.radians(35.0)
"""Of images of which nothing is known: half of the tilts lie below 40 degrees."""

_TILT_SPREAD_START = math.radians(3.0)
_MIN_TILT_SPREAD = math.radians(0.05)
_ROUNDS = 3  # rounds of estimating the scales of priors
_SETTLED = 0.1  # relative change of a scale that is none
_MISFIT = 1.5  # times the errors of links on their own from which on those of a model are its own


@dataclass(frozen=True, eq=False)
class Fit:
    """One model adjusted to a problem."""

    model: MotionModel
    result: BundleAdjustmentResult
    tilt_spread: float | None = None  # standard deviation of the images' own tilts, radians; None without such

    @property
    def free_lens(self) -> BoolArray:
        """Lens parameters that were estimated, (5,)."""
        return self.result.adjuster.free.lens

    @property
    def overdispersion(self) -> float:
        """Overdispersion of the errors that it leaves, at least that of the problem; see :class:`BundleAdjuster`."""
        return self.result.adjuster.overdispersion

    @property
    def bare(self) -> Self:
        """See :attr:`BundleAdjustmentResult.bare`."""
        return replace(self, result=self.result.bare)


@dataclass(frozen=True)
class _Scales:
    """What a fit estimates of its own priors and errors."""

    tilt_spread: float  # standard deviation of the images' own tilts, radians
    overdispersion: float  # see BundleAdjuster


@dataclass(frozen=True, eq=False)
class LinkProblem:
    """Links to be adjusted, each on its own, with a lens in common."""

    observations: Observations  # links between the images 0 … N-1
    homographies: FloatArray  # (L, 3, 3): of the links, at the ``lens``
    lens: FloatArray  # (5,): where to start
    free_lens: BoolArray  # (5,)
    camera_priors: CameraPriors

    def at(self, adjusted: BundleAdjustmentResult, free_lens: BoolArray) -> Self:
        """The problem from where an adjustment has put links and lens, with so much of the lens free."""
        lens = adjusted.parameters.lens
        return replace(self, homographies=adjusted.homographies, lens=lens, free_lens=free_lens)


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem(LinkProblem):
    """Connected images to be aligned."""

    trust: FloatArray  # (L,): how much each link can be relied on to start with
    count: int  # N
    fixed: int | None  # the image that fixes the gauge; None: part chooses one
    overdispersion: float = 1.0  # overdispersion, min_gain: see BundleAdjuster
    min_gain: float = MIN_GAIN

    @property
    def reference(self) -> int:
        """The image that fixes the gauge, of a part."""
        assert self.fixed is not None, "only a part of a problem has a reference"
        return self.fixed

    def part(self, kept: BoolArray, images: IntArray | None = None) -> tuple[Self, IntArray]:
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

    def refine(self, model: MotionModel, start: Parameters, tilt_spread: float | None = None) -> Fit:
        """Adjust a model from a given start, with the scales of its priors: the tilts' spread, the errors' dependence.

        What neighbours share in the errors belongs to the model: where that is large, priors count for more.
        """
        measured = self.camera_priors.attitudes_std
        if self._estimates_tilt_spread(model):
            spread = _TILT_SPREAD_START if tilt_spread is None else tilt_spread
        else:
            spread = POSE_TILT_SPREAD if model.any_tilt and measured is None else measured or 0.0
        scales, at = _Scales(spread, self.overdispersion), start
        for rounds in itertools.count(1):
            adjuster = self.adjuster(model, scales.tilt_spread, at.shared, scales.overdispersion)
            adjusted = adjuster.run(at, wide_start=True)
            scales, changed = self._rescaled(scales, adjusted, rounds)
            if not changed:
                tilt_spread_used = scales.tilt_spread if model.free_tilts else None
                return Fit(model, adjusted, tilt_spread_used)
            at = adjusted.parameters
        raise AssertionError("scales settle")

    def _estimates_tilt_spread(self, model: MotionModel) -> bool:
        return model.free_tilts and not model.any_tilt and self.camera_priors.attitudes_std is None

    def _rescaled(self, scales: _Scales, adjusted: BundleAdjustmentResult, rounds: int) -> tuple[_Scales, bool]:
        """The scales that an adjustment shows, and whether they differ by so much that it is to be repeated."""
        model = adjusted.adjuster.model
        # Attitudes are divided by the focal length.
        changed = model.free_tilts and self.camera_priors.attitudes_std is not None and rounds == 1
        if self._estimates_tilt_spread(model) and rounds <= _ROUNDS:
            tilts = adjusted.parameters.poses[:, [PSI, THETA]] * model.focal(adjusted.parameters.shared)
            spread = max(float(np.sqrt(np.mean(tilts**2))), _MIN_TILT_SPREAD)
            changed = abs(spread - scales.tilt_spread) > _SETTLED * scales.tilt_spread
            scales = replace(scales, tilt_spread=spread)
        first = scales.overdispersion == self.overdispersion
        if not changed and first and adjusted.sigma > _MISFIT * self._link_sigma:
            shared = shared_variance(self.observations, adjusted.errors, adjusted.inliers)
            scales = replace(scales, overdispersion=max(self.overdispersion, shared))
            changed = scales.overdispersion > self.overdispersion
        return scales, changed

    @cached_property
    def _link_sigma(self) -> float:
        """Standard deviation of a coordinate of the errors of links on their own, pixels."""
        squared = squared_lengths(whitened_errors(self.observations, self.homographies, self.lens))
        return self.observations.sigma(squared)

    def extend(self, fit: Fit, lens: BoolArray) -> Fit:
        """Fit the same model with more of the lens free."""
        wider = replace(self, free_lens=self.free_lens | lens)
        return wider.refine(fit.model, fit.result.parameters, fit.tilt_spread)

    def adjuster_of(self, fit: Fit) -> BundleAdjuster:
        """The adjuster of a fit, with the priors on it."""
        return self.adjuster(fit.model, fit.tilt_spread, fit.result.parameters.shared, fit.overdispersion)

    def adjuster(
        self,
        model: MotionModel,
        tilt_spread: float | None = None,
        shared: FloatArray | None = None,
        overdispersion: float | None = None,
    ) -> BundleAdjuster:
        """The adjuster of one model with its priors; those of tilts as they show with the ``shared`` parameters."""
        tilt_spread = _TILT_SPREAD_START if tilt_spread is None else tilt_spread
        references = [self.reference] if self.camera_priors.fix_frame else []
        freedom = FreeParameters.fixing(model, self.count, references, self.free_lens)
        log_focal = None if shared is None or not len(shared) else model.log_focal(shared)
        priors = self.camera_priors.priors(model, self.count, tilt_spread, log_focal)
        overdispersion = overdispersion or self.overdispersion
        return BundleAdjuster(model, self.observations, freedom, priors, overdispersion, min_gain=self.min_gain)
