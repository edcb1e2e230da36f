"""How pairs are estimated."""

import math
from dataclasses import dataclass
from typing import Annotated

from rdstitch.choices import SolverName
from rdstitch.errors import ArgumentError
from rdstitch.options.option import Option, check_options

Solver = Annotated[SolverName, Option("Minimal solver of the pairs.")]
Threshold = Annotated[
    float,
    Option(
        "Largest error of an inlier, pixels of the size that features are detected at (see --work-megapixels).",
        "PX",
        above=0.0,
        most=1e4,  # more than an image is wide
    ),
]
Confidence = Annotated[
    float, Option("Probability that no better model of a pair was missed.", above=0.0, below=1.0, command_line=False)
]
Iterations = Annotated[int, Option("Samples a pair, over all solvers.", least=1, command_line=False)]
Seed = Annotated[int, Option("Random seed.", least=0)]


@dataclass(frozen=True)
class EstimationOptions:
    """Which solvers search, what counts as agreement, and when to stop."""

    solver: Solver = "auto"
    distortion: float | None = None  # known λ in the half-diagonal frame; it is then not estimated
    threshold: Threshold = 3.0
    confidence: Confidence = 0.999
    max_iterations: Iterations = 10000
    seed: Seed = 0
    # inliers below which the models of planar motion compete with the free homography, which needs more of them; None:
    # always
    select_below: int | None = None

    def __post_init__(self) -> None:
        check_options(self)
        if self.distortion is not None and self.solver != "auto":
            raise ArgumentError(f"with known distortion there is nothing to choose; leave out solver={self.solver!r}")
        if self.distortion is not None and not -math.inf < self.distortion < 1.0:
            raise ArgumentError(f"distortion must be a number below 1, not {self.distortion}")
