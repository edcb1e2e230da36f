"""Ground truth: problem instances and rendered image sequences, for tests, examples and benchmarks."""

from rdstitch.synthetic.instances import Instances, PlanarInstances, general_instances, planar_instances

__all__ = ["Instances", "PlanarInstances", "general_instances", "planar_instances"]
