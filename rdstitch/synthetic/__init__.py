"""Ground truth: problem instances, matches and rendered image sequences, for tests, examples and benchmarks."""

from rdstitch.synthetic.alignment import AlignmentError, alignment_error
from rdstitch.synthetic.comparison import PlaneComparison, compare_with_plane, coverage, plane_under, sharpness
from rdstitch.synthetic.correspondences import SyntheticMatches, correspondences
from rdstitch.synthetic.fitting import fit_homography, fit_similarity
from rdstitch.synthetic.instances import HALF_SIZE, Instances, PlanarInstances, general_instances, planar_instances
from rdstitch.synthetic.layouts import (
    drive_poses,
    grid_poses,
    joined,
    line_poses,
    pair_poses,
    parking_poses,
    rotation_poses,
    survey_poses,
    turn_poses,
)
from rdstitch.synthetic.lenses import BrownLens, FisheyeLens, Lens, best_division_model
from rdstitch.synthetic.poses import Poses, fit_to_plane
from rdstitch.synthetic.relief import RELIEFS, Relief, boxes, hills, ridges
from rdstitch.synthetic.rendering import Photometry, Sequence, sequence_over
from rdstitch.synthetic.textures import (
    EndlessTexture,
    LinedTexture,
    PictureTexture,
    Texture,
    blank,
    gradient,
    ground,
    repeated,
)

__all__ = [
    "HALF_SIZE",
    "RELIEFS",
    "AlignmentError",
    "BrownLens",
    "EndlessTexture",
    "FisheyeLens",
    "Instances",
    "Lens",
    "LinedTexture",
    "Photometry",
    "PictureTexture",
    "PlanarInstances",
    "PlaneComparison",
    "Poses",
    "Relief",
    "Sequence",
    "SyntheticMatches",
    "Texture",
    "alignment_error",
    "best_division_model",
    "blank",
    "boxes",
    "compare_with_plane",
    "correspondences",
    "coverage",
    "drive_poses",
    "fit_homography",
    "fit_similarity",
    "fit_to_plane",
    "general_instances",
    "gradient",
    "grid_poses",
    "ground",
    "hills",
    "joined",
    "line_poses",
    "pair_poses",
    "parking_poses",
    "planar_instances",
    "plane_under",
    "repeated",
    "ridges",
    "rotation_poses",
    "sequence_over",
    "sharpness",
    "survey_poses",
    "turn_poses",
]
