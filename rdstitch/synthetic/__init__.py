"""Ground truth: problem instances, matches and rendered image sequences, for tests, examples and benchmarks."""

from rdstitch.synthetic.correspondences import SyntheticMatches, correspondences
from rdstitch.synthetic.instances import Instances, PlanarInstances, general_instances, planar_instances
from rdstitch.synthetic.lenses import BrownLens, FisheyeLens, Lens, best_division_model
from rdstitch.synthetic.poses import Poses, fit_to_plane
from rdstitch.synthetic.rendering import Photometry, Relief, Sequence, boxes
from rdstitch.synthetic.textures import (
    EndlessTexture,
    PictureTexture,
    Texture,
    blank,
    gradient,
    ground,
    repeated,
)

__all__ = [
    "BrownLens",
    "EndlessTexture",
    "FisheyeLens",
    "Instances",
    "Lens",
    "Photometry",
    "PictureTexture",
    "PlanarInstances",
    "Poses",
    "Relief",
    "Sequence",
    "SyntheticMatches",
    "Texture",
    "best_division_model",
    "blank",
    "boxes",
    "correspondences",
    "fit_to_plane",
    "general_instances",
    "gradient",
    "ground",
    "planar_instances",
    "repeated",
]
