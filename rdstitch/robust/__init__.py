from rdstitch.choices import SOLVERS, SolverName
from rdstitch.robust.estimate import PairMatches, estimate_radial_homographies, estimate_radial_homography
from rdstitch.robust.estimation_options import EstimationOptions

__all__ = [
    "SOLVERS",
    "EstimationOptions",
    "PairMatches",
    "SolverName",
    "estimate_radial_homographies",
    "estimate_radial_homography",
]
