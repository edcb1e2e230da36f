"""How pairs are estimated."""

from dataclasses import dataclass

from rdstitch.choices import SolverName
from rdstitch.errors import ArgumentError
from rdstitch.options.option import Options, Range, option


@dataclass(frozen=True)
class RansacOptions(Options):
    """How the motion of a pair is searched: which solvers, what counts as agreement, and when to stop."""

    solver: SolverName = option("auto", "Minimal solver of the pairs.")
    threshold: float = option(
        3.0,
        "Largest error of an inlier, pixels of the size that features are detected at (see --work-megapixels).",
        "PX",
        within=Range(above=0.0, most=1e4),  # more than an image is wide
    )
    confidence: float = option(
        0.999, "Probability that no better model of a pair was missed.", within=Range(above=0.0, below=1.0), flag=None
    )
    max_iterations: int = option(10000, "Samples a pair, over all solvers.", within=Range(least=1), flag=None)
    seed: int = option(0, "Random seed.", within=Range(least=0))

    def refuse_solver(self) -> None:
        """Refuse a solver where λ is known: which one is used depends on nothing else then."""
        if self.solver != "auto":
            raise ArgumentError(f"with a known λ no solver can be chosen; leave out solver={self.solver!r}")


@dataclass(frozen=True)
class EstimationOptions(RansacOptions):
    """The same with what is known of the lens, and of how many matches a pair needs."""

    distortion: float | None = option(
        None, "Known λ in the half-diagonal frame; it is then not estimated.", within=Range(below=1.0)
    )
    select_below: int | None = option(
        None,
        "Inliers below which the models of planar motion compete with the free homography, which needs more of them; "
        "None: always.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.distortion is not None:
            self.refuse_solver()
