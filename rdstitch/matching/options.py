"""How images are matched and pairs are estimated."""

from pathlib import Path

from rdstitch.errors import ArgumentError
from rdstitch.frozen import dataclass
from rdstitch.robust import SOLVERS, EstimationOptions, RansacOptions

_SELECT_MODEL_BELOW = 50
"""Inliers from which on a free homography is as sure as a motion of the plane; the alignment decides between them."""


@dataclass(frozen=True)
class PairOptions:
    """How the two-view geometry of a pair is estimated."""

    solver: str = "auto"  # one of rdstitch.robust.SOLVERS
    distortion: float | None = None  # known λ, half-diagonal frame
    threshold: float = 3.0  # pixels, largest transfer error of an inlier
    confidence: float = 0.999  # probability that no better model was missed
    max_iterations: int = 10000  # samples per pair
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the solver's name before long work begins."""
        if self.solver not in SOLVERS:
            raise ArgumentError(f"unknown solver {self.solver!r}; choose one of {', '.join(SOLVERS)}")

    @property
    def estimation(self) -> EstimationOptions:
        """The same as the estimation of many pairs takes it."""
        limits = RansacOptions(self.threshold, self.confidence, self.max_iterations, self.seed)
        return EstimationOptions(self.solver, self.distortion, limits, _SELECT_MODEL_BELOW)


@dataclass(frozen=True)
class MatchingOptions:
    """How the pairs of a whole set are matched and estimated."""

    pair: PairOptions = PairOptions()  # its λ is that of all images, where it is known
    ratio: float | None = None  # largest ratio of distances of a match; None: what suits the features
    lightglue_model: str | Path | None = None  # ONNX file of a network that matches the features instead
    workers: int = 1  # pairs matched at the same time
