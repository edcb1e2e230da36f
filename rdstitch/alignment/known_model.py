"""What a draft has found, for a draft by more links between the same images to start from."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.alignment.adjustment_problem import Problem
from rdstitch.alignment.build_result import AdjustedImages
from rdstitch.alignment.least_squares.bundle_adjustment import Parameters
from rdstitch.alignment.motion_models import MODELS
from rdstitch.alignment.select import ModelChoice
from rdstitch.arrays import BoolArray, IntArray
from rdstitch.choices import ModelName


@dataclass(frozen=True, eq=False)
class KnownModel:
    """The model that was chosen, and its solution."""

    model: ModelName
    images: IntArray  # (N,): those aligned, of all images
    reference: int  # the one that fixes the gauge, of all images
    parameters: Parameters
    free_lens: BoolArray  # (5,): what of the lens was estimated
    tilt_spread: float | None  # see Fit
    others: str  # see ModelChoice

    @classmethod
    def of(cls, draft: AdjustedImages) -> Self | None:
        """The model of a draft; None over relief, whose heights are found for each set of links."""
        fit = draft.fit
        if draft.choice.over_relief:
            return None
        reference, parameters = int(draft.images[draft.problem.reference]), fit.result.parameters
        others = draft.choice.others
        return cls(fit.model.name, draft.images, reference, parameters, fit.free_lens, fit.tilt_spread, others)

    def choice(self, problem: Problem, images: IntArray) -> ModelChoice | None:
        """The model adjusted to a problem, from its solution; None where other images are connected."""
        if not np.array_equal(images, self.images):
            return None
        wider = replace(problem, free_lens=problem.free_lens | self.free_lens)
        return ModelChoice(wider.refine(MODELS[self.model], self.parameters, self.tilt_spread), self.others)
