"""Ground truth: problem instances and rendered image sequences, for tests, examples and benchmarks."""

from rdstitch.synthetic.correspondences import SyntheticMatches, correspondences
from rdstitch.synthetic.instances import Instances, PlanarInstances, general_instances, planar_instances

__all__ = [
    "Instances",
    "PlanarInstances",
    "SyntheticMatches",
    "correspondences",
    "general_instances",
    "planar_instances",
]
