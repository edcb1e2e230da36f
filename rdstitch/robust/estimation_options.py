"""How pairs are estimated."""

import math
from dataclasses import dataclass

from rdstitch.choices import SOLVERS
from rdstitch.errors import ArgumentError


@dataclass(frozen=True)
class EstimationOptions:
    """Which solvers search, what counts as agreement, and when to stop."""

    solver: str = "auto"  # one of :data:`SOLVERS`
    distortion: float | None = None  # known λ in the half-diagonal frame; it is then not estimated
    threshold: float = 3.0  # pixels, largest transfer error of an inlier
    confidence: float = 0.999  # probability that a better model was not missed
    max_iterations: int = 10000  # samples a pair, over all solvers
    seed: int = 0
    # inliers below which the models of planar motion compete with the free homography, which needs more of them; None:
    # always
    select_below: int | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.solver not in SOLVERS:
            raise ArgumentError(f"unknown solver {self.solver!r}; choose one of {', '.join(SOLVERS)}")
        if self.distortion is not None and self.solver != "auto":
            raise ArgumentError(f"with known distortion there is nothing to choose; leave out solver={self.solver!r}")
        if self.distortion is not None and not -math.inf < self.distortion < 1.0:
            raise ArgumentError(f"distortion must be a number below 1, not {self.distortion}")
        if not self.threshold > 0.0 or not 0.0 < self.confidence < 1.0 or self.max_iterations < 1:
            raise ArgumentError("threshold and max_iterations must be positive, confidence between 0 and 1")
