"""The simplest lens that the images allow: λ; λ and the distortion centre; μ besides; ν besides.

The lenses are compared where nothing else is assumed: every link on its own with a homography, and one lens for all.
What a richer lens gains there is no irregular motion that it takes the blame for. They are compared by their posterior
(:mod:`rdstitch.robust.posterior`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Self

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, LinkProblem, Problem
from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjustmentResult
from rdstitch.alignment.noise import Coherence, coherence, evidence_of
from rdstitch.alignment.pairwise import pairwise_homographies
from rdstitch.arrays import BoolArray
from rdstitch.choices import LensName
from rdstitch.geometry.camera import LENS_PARAMETERS
from rdstitch.robust.posterior import Evidence
from rdstitch.robust.priors import LENS_PRIORS, TWENTY_TO_ONE, prior_costs

LENSES: dict[LensName, tuple[str, ...]] = {
    "division": ("distortion",),
    "division-center": ("distortion", "center_x", "center_y"),
    "division2": ("distortion", "distortion2", "center_x", "center_y"),
    "division3": LENS_PARAMETERS,
}
"""Parameters of each lens of the ladder, from the simplest."""

CENTER = np.array([name.startswith("center") for name in LENS_PARAMETERS])
"""Which of :data:`rdstitch.geometry.camera.LENS_PARAMETERS` are the distortion centre, shape (5,)."""

NO_COHERENCE = 0.3
"""Correlation of the errors of neighbours up to which nothing else can be to blame: relief leaves more."""

ENOUGH_IMAGES = 4
"""Images from which on the distortion centre is freed where every link is on its own. In fewer a tilt and a change of
height stand for it, and pairs like those of ``examples.paper figure5`` are registered worse with it free."""

_ENOUGH_IMAGES_OF_A_MOTION = 3  # the same where one camera explains all of them

_ENOUGH_LINKS = 2000
"""Of more links, evenly chosen ones say which lens it is: all of them determine it many times over, and each of the
lenses takes memory and time for each of them."""


class LensEvidence(Enum):
    """What the images show of λ."""

    SUFFICIENT = auto()  # it is observable, or given
    LITTLE_MOTION = auto()
    DEPTH = auto()  # few images, of something with depth, which looks like a lens


@dataclass(frozen=True, eq=False)
class LensChoice:
    """The lens chosen."""

    name: LensName  # a key of LENSES
    free: BoolArray  # (5,): its parameters among LENS_PARAMETERS
    pairwise: BundleAdjustmentResult  # every link on its own with this lens
    reason: str  # one sentence
    # what may still be freed, where the motion model shows it: a distortion centre that is off the middle looks like
    # motion that is less regular. That μ is needed only pairs can say: it could stand for relief
    refinements: tuple[BoolArray, ...] = ()
    evidence: LensEvidence = LensEvidence.SUFFICIENT

    @classmethod
    def held(
        cls, pairwise: BundleAdjustmentResult, reason: str, evidence: LensEvidence = LensEvidence.SUFFICIENT
    ) -> Self:
        """The lens as it was before: given, or not observable."""
        return cls("division", np.zeros(len(LENS_PARAMETERS), dtype=np.bool_), pairwise, reason, evidence=evidence)

    @property
    def observable(self) -> bool:
        """Whether λ is observable, or known."""
        return self.evidence is LensEvidence.SUFFICIENT

    def refined(self, free: BoolArray) -> Self:
        """The choice with the parameters that were freed in the end."""
        if (free == self.free).all():
            return self
        name = next(name for name in LENSES if not (free & ~free_parameters(name)).any())
        more = "ν is the next term of a series that needs μ" if free[2] else "the motion is more regular with that"
        return replace(self, name=name, free=free, reason=f"{name}: {more}")


def free_parameters(name: LensName) -> BoolArray:
    """Which of :data:`rdstitch.geometry.camera.LENS_PARAMETERS` a lens of the ladder has, shape (5,)."""
    return np.array([parameter in LENSES[name] for parameter in LENS_PARAMETERS])


def choose_lens(links: LinkProblem, pairwise: BundleAdjustmentResult, names: Sequence[LensName]) -> LensChoice:
    """Choose among lenses, from the simplest; ``pairwise`` is every link on its own with a homography, and λ free."""
    observations, images = links.observations, links.observations.image_count
    if len(names) > 1 and len(observations) > _ENOUGH_LINKS:
        return _choose_by_some(links, pairwise, names)
    few = len(names) > 1 and images < ENOUGH_IMAGES
    if few:
        names = [name for name in names if name != "division-center"]
    free = [free_parameters(name) & ~(CENTER & few) for name in names]

    if len(names) == 1:
        if names[0] != "division":
            pairwise = pairwise_homographies(links.at(pairwise, free[0]))
        return LensChoice(names[0], free[0], pairwise, "as requested")
    fits, best = [pairwise], 0
    for index, name in enumerate(names[1:], start=1):
        if name == "division3" and names[best] != "division2":
            break  # the next term of a series that is not needed
        fits.append(pairwise_homographies(links.at(fits[-1], free[index])))
        evidence = evidence_of(observations, fits[-1].errors)
        rarer = 0.0 if names[best] == "division2" else TWENTY_TO_ONE  # a series that was cut off has a next term
        if _cost(evidence, fits[index]) + rarer < _cost(evidence, fits[best]):
            best = index
    reason = _reason(names, fits, best)
    if few:
        reason += "; too few images to find the distortion centre, which is taken to be the middle"
    refinements = (CENTER,) if best == 0 and images >= _ENOUGH_IMAGES_OF_A_MOTION else ()
    return LensChoice(names[best], free[best], fits[best], reason, refinements)


def _choose_by_some(links: LinkProblem, pairwise: BundleAdjustmentResult, names: Sequence[LensName]) -> LensChoice:
    """The lens that evenly chosen links show, and every link on its own with it."""
    simplest = free_parameters("division")
    some = np.arange(0, len(links.observations), -(-len(links.observations) // _ENOUGH_LINKS))
    few = links.at(pairwise, simplest)
    few = replace(few, observations=few.observations.subset(some), homographies=few.homographies[some])
    choice = choose_lens(few, pairwise_homographies(few), names)
    if (choice.free != simplest).any():
        pairwise = pairwise_homographies(links.at(pairwise, choice.free))
    return replace(choice, pairwise=pairwise)


def residual_coherence(adjusted: BundleAdjustmentResult) -> Coherence:
    """How much the errors of neighbours agree that an adjustment leaves."""
    return coherence(adjusted.adjuster.observations, adjusted.errors, adjusted.inliers)


def with_third_coefficient(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """A problem and its fit, with ν free where all images together may show it; pairs alone hardly do.

    A lens that needs μ is a series that was cut off, so that its next term is not zero and needs no proof: freed where
    it is smaller than its standard deviation it costs next to nothing, and left out where it is not it bends the image
    by a tenth of a pixel. Only where the errors are noise: over relief a motion model would take ν for the ground.
    """
    finer = free_parameters("division3")
    if problem.count < ENOUGH_IMAGES or (fit.free_lens != free_parameters("division2")).any():
        return problem, fit
    if residual_coherence(fit.result).correlation >= NO_COHERENCE:
        return problem, fit
    return replace(problem, free_lens=finer), problem.extend(fit, finer)


def _cost(evidence: Evidence, fit: BundleAdjustmentResult) -> float:
    """-2 log of the posterior of a lens, up to a constant."""
    parameters = int(fit.adjuster.free.lens.sum())
    return float(evidence.cost(fit.errors, parameters, prior_costs(LENS_PRIORS, fit.parameters.lens).sum())[0])


def _reason(names: Sequence[str], fits: Sequence[BundleAdjustmentResult], best: int) -> str:
    """Why a lens was chosen, one sentence."""
    errors = [f"{name} {fit.sigma:.3f} pixels" for name, fit in zip(names, fits, strict=False)]
    text = f"{names[best]}: pairs on their own leave an error of {fits[best].sigma:.3f} pixels"
    if best:
        text += f", simpler lenses more ({', '.join(errors[:best])})"
    if best + 1 < len(fits):
        text += f", more parameters gain too little ({', '.join(errors[best + 1 :])})"
    return text
