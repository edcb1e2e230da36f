"""Which motion the images show: one posterior cost for all hypotheses.

The cost is that of :mod:`rdstitch.robust.posterior`; a layout that nobody would keep has none.

A camera that stays where it is sees the same of a plane as of anything else: where a turn explains the images, models
over a plane do so too, with more parameters, so that the turn is taken where it fits, and a plane where there is
translation. Of the planar models the least free one is taken that the images allow.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.frames.reference_frame import MAX_STRETCH, stretch
from rdstitch.alignment.least_squares.link_equations import whitened_errors
from rdstitch.alignment.lens.lens_selection import NO_COHERENCE, residual_coherence
from rdstitch.alignment.motion_models import MODELS, MotionModel
from rdstitch.alignment.noise import evidence_of
from rdstitch.alignment.pairwise import fit_pairwise
from rdstitch.alignment.starts import fit_model
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.choices import ModelName, Purpose
from rdstitch.robust.posterior import Evidence
from rdstitch.robust.priors import TWENTY_TO_ONE

_MIN_RATIO = 3.0
"""Times by which the errors of one camera must exceed those of free homographies, one an image, where numbers are
wanted: these fit relief better than any camera does, by up to 2.2 times over strips of rendered relief, and their
chains drift projectively. In pictures seams say what errors matter."""

_TYPICAL_TILT_SPREAD = math.radians(3.0)
"""Spread of tilts from which on a wider one costs: Occam's factor of the hierarchical prior on the tilts."""

_TOLERABLE = 0.25
"""Of what an error counts at most: shared errors, besides the noise, that local alignment and seams can hide."""


@dataclass(frozen=True)
class ModelChoice:
    """The model chosen, why, and whether with heights of the ground that account for errors along the parallax."""

    fit: Fit
    others: str  # how it compares with other models
    over_relief: bool = False

    @property
    def reason(self) -> str:
        """One sentence."""
        model, adjusted = self.fit.model, self.fit.result
        described = model.description(adjusted.parameters.poses, adjusted.parameters.shared)
        return f"{model.name}: {described}; most matches fit to {adjusted.sigma:.2f} pixels{self.others}"


@dataclass(frozen=True)
class Hypothesis:
    """A fit with its posterior cost."""

    fit: Fit
    cost: float  # -2 log of the posterior, up to a constant of the problem
    field: float  # size of what the errors of neighbours share, pixels of a coordinate
    stretch: float  # of its layout: the ratio of areas, inf where images are folded; 1 where it is not asked for

    @property
    def implausible(self) -> bool:
        """Whether areas are stretched out of proportion, or images folded."""
        return not self.stretch <= MAX_STRETCH


@dataclass(frozen=True)
class Posterior:
    """Compares fits of one problem."""

    problem: Problem
    purpose: Purpose = Purpose.MOSAIC

    @cached_property
    def link_errors(self) -> FloatArray:
        """Whitened errors (M, 2) of links fitted on their own, pixels."""
        return whitened_errors(self.problem.observations, self.problem.homographies, self.problem.lens)

    @cached_property
    def evidence(self) -> Evidence:
        """The cells that errors are compared by."""
        return evidence_of(self.problem.observations, self.link_errors)

    @cached_property
    def tolerable(self) -> float:
        """Shared errors, pixels of a coordinate, that local alignment and seams can hide."""
        return math.hypot(_TOLERABLE * float(self.evidence.farthest[0]), float(self.evidence.noise[0]))

    def hypothesis(self, fit: Fit) -> Hypothesis:
        """The hypothesis of a fit."""
        # Of any model what its errors show, whatever its freedom costs: it is held against what seams can hide.
        field = float(self.evidence.field(fit.result.errors)[0])
        layout = stretch(fit) if self.purpose.picture else 1.0
        spread = (fit.tilt_spread or 0.0) / _TYPICAL_TILT_SPREAD
        wide = 4.0 * self.problem.count * math.log(max(spread, 1.0))
        priors = self.problem.adjuster_of(fit).camera_prior_cost(fit.result.parameters)
        cost = self.lower_bound(fit.model, fit.result.errors, fit.free_lens) + wide + priors
        return Hypothesis(fit, cost, field, layout)

    def lower_bound(self, model: MotionModel, errors: FloatArray, free_lens: BoolArray | None = None) -> float:
        """The cost of a model that leaves such errors (M, 2), of a camera that is as cameras are."""
        # In the pose model the shared tilt is only the mean of those of the images.
        poses = self.problem.count * model.pose_size - int(model.gauge.sum()) - (2 if model.any_tilt else 0)
        lens = self.problem.free_lens if free_lens is None else free_lens
        preference = TWENTY_TO_ONE if model.on_sphere != (self.purpose is Purpose.PANO) else 0.0
        return float(self.evidence.cost(errors, poses + len(model.shared_names) + int(lens.sum()), preference)[0])

    def suffices(self, best: Hypothesis, model: MotionModel) -> bool:
        """Whether a freer model could not be taken, even if it left the errors that links leave on their own."""
        # What neighbours share of these errors no model undercuts by much.
        if not (model.one_camera or _is_beyond_one_camera(self, best, float(self.evidence.field(self.link_errors)[0]))):
            return True
        return not best.implausible and best.cost <= self.lower_bound(model, self.link_errors)


def select_model(
    problem: Problem, names: Sequence[ModelName], lenses: Sequence[BoolArray] = (), purpose: Purpose = Purpose.MOSAIC
) -> ModelChoice:
    """Adjust hypotheses from the least to the most free, and take the one with the least cost.

    Models are no longer tried that could not pay for their freedom even with the errors that links leave on their own;
    nor is a turn that could not with those of links that are turns on their own.
    The best two and the least free one are then tried with more of the lens free: an off-centre lens acts like less
    regular motion. Free homographies are a model of another kind, taken only for what one camera cannot explain.
    """
    posterior = Posterior(problem, purpose)
    models = [MODELS[name] for name in names]
    planar = [model for model in models if not model.on_sphere]
    wide = replace(problem, free_lens=np.logical_or.reduce([problem.free_lens, *lenses]))
    turns = [model for model in models if model.on_sphere]  # one at most
    bound, shared = _bound_of_turn(posterior, wide, turns[0]) if turns else (math.inf, None)

    def turned() -> list[Hypothesis]:
        return [posterior.hypothesis(fit_model(problem, model, shared=shared)) for model in turns]

    late = bool(planar and turns) and bound >= posterior.lower_bound(planar[0], posterior.link_errors)
    free = not all(model.one_camera for model in models)
    tried = _with_planar(posterior, [] if late else turned(), planar, free=free)
    if late:
        best = min((one for one in tried if one.fit.model.one_camera), key=_cost)
        if best.implausible or bound < best.cost:
            tried = [*turned(), *tried]
    tried = _with_wider_lenses(posterior, tried, lenses)
    return _choice(tried, _best(posterior, tried), requested=len(names) == 1)


def _bound_of_turn(posterior: Posterior, problem: Problem, model: MotionModel) -> tuple[float, FloatArray | None]:
    """What a turn of all images costs at least, by links that are turns on their own, and parameters to start from."""
    if len(problem.observations) == 1:  # a trial is the whole
        return -math.inf, None
    pairs, shared = fit_pairwise(problem, model)
    return posterior.lower_bound(model, pairs.errors), shared


def _with_planar(
    posterior: Posterior, tried: Sequence[Hypothesis], models: Sequence[MotionModel], *, free: bool
) -> list[Hypothesis]:
    """Try planar models, from the least to the most free, which are ``free`` homographies or not."""
    tried = list(tried)
    for model in models:
        if posterior.problem.count == 2 and model.free_tilts and free:
            continue  # with two images, one camera that tilts is a homography
        if tried and posterior.suffices(min(tried, key=_cost), model):
            break
        planes = [one.fit for one in tried if not one.fit.model.on_sphere]
        tried.append(posterior.hypothesis(fit_model(posterior.problem, model, planes[-1:])))
    return tried


def best_of(problem: Problem, fits: Sequence[Fit], purpose: Purpose, *, requested: bool) -> ModelChoice | None:
    """Take the best of some fits of the problem; None where nobody would keep the layout of any."""
    posterior = Posterior(problem, purpose)
    tried = [posterior.hypothesis(fit) for fit in fits]
    tried = [one for one in tried if not one.implausible]
    return _choice(tried, _best(posterior, tried), requested=requested) if tried else None


def _with_wider_lenses(
    posterior: Posterior, tried: Sequence[Hypothesis], lenses: Sequence[BoolArray]
) -> list[Hypothesis]:
    """Free more of the lens where that pays."""
    tried = list(tried)
    for lens in lenses:
        order = sorted(range(len(tried)), key=lambda index: tried[index].cost)[:2]
        for index in sorted({0, *order}):
            fit = tried[index].fit
            wider = posterior.hypothesis(posterior.problem.extend(fit, lens | fit.free_lens))
            # A centre that is off bends a plane as rough ground bends the images; directions it does not bend.
            shown = fit.model.on_sphere or residual_coherence(wider.fit.result).correlation < NO_COHERENCE
            if wider.cost < tried[index].cost and shown:
                tried[index] = wider
    return tried


def _best(posterior: Posterior, tried: Sequence[Hypothesis]) -> Hypothesis:
    """The one with the least cost; free homographies only of what one camera does not explain.

    Where a plane that nobody would lay out explains the images, so do free homographies: a turn whose errors seams can
    hide is taken instead; so it is of a picture where homographies are hardly more probable.
    """
    cameras = [one for one in tried if one.fit.model.one_camera] or tried
    best = min(cameras, key=_cost)
    free = [one for one in tried if not one.fit.model.one_camera]
    chosen = min([best, *(one for one in free if _is_beyond_one_camera(posterior, best, one.field))], key=_cost)
    hidden = [one for one in tried if one.field < posterior.tolerable and not one.implausible]
    turns, kept = [one for one in hidden if one.fit.model.on_sphere], list[Hypothesis]()
    if best.implausible:
        kept = turns or (hidden if math.isinf(best.stretch) else [])
    elif posterior.purpose.picture and not chosen.fit.model.one_camera:
        kept = [one for one in turns if one.cost < chosen.cost + TWENTY_TO_ONE]
    return min(kept, key=_cost, default=chosen)


def _cost(one: Hypothesis) -> float:
    return one.cost


def _is_beyond_one_camera(posterior: Posterior, best: Hypothesis, free: float) -> bool:
    """Whether free homographies compete, of a picture whatever their field is; two images need no more than one."""
    largest = posterior.tolerable if posterior.purpose.picture else _MIN_RATIO * free
    return posterior.problem.count == 2 or best.implausible or best.field > largest


def _choice(tried: Sequence[Hypothesis], best: Hypothesis, *, requested: bool) -> ModelChoice:
    if requested:
        return ModelChoice(best.fit, "; as requested")
    listed = [
        f"{one.fit.model.name} {one.fit.result.sigma:.2f} pixels"
        + (", an impossible layout" if one.implausible else f", {one.cost - best.cost:+.0f}")
        for one in tried
        if one is not best
    ]
    others = f" (others: {'; '.join(listed)})" if listed else ""
    return ModelChoice(best.fit, others)
