"""Ground truth: rendered image sequences, for tests, examples and benchmarks."""

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
from rdstitch.synthetic.panorama import TurningSequence, camera_rotations, panorama_rotations, turning_sequence
from rdstitch.synthetic.poses import Poses, fit_to_plane
from rdstitch.synthetic.relief import RELIEFS, Relief, boxes, hills, ridges
from rdstitch.synthetic.rendering import Photometry, Sequence, sequence_over
from rdstitch.synthetic.textures import (
    EndlessTexture,
    ImageTexture,
    Texture,
    blank,
    gradient,
    ground,
    repeated,
)

__all__ = [
    "RELIEFS",
    "BrownLens",
    "EndlessTexture",
    "FisheyeLens",
    "ImageTexture",
    "Lens",
    "Photometry",
    "Poses",
    "Relief",
    "Sequence",
    "Texture",
    "TurningSequence",
    "best_division_model",
    "blank",
    "boxes",
    "camera_rotations",
    "drive_poses",
    "fit_to_plane",
    "gradient",
    "grid_poses",
    "ground",
    "hills",
    "joined",
    "line_poses",
    "pair_poses",
    "panorama_rotations",
    "parking_poses",
    "repeated",
    "ridges",
    "rotation_poses",
    "sequence_over",
    "survey_poses",
    "turn_poses",
    "turning_sequence",
]
