"""Ground truth: rendered image sequences, for tests, examples and benchmarks."""

from rdstitch.synthetic.lenses import BrownLens, FisheyeLens, Lens
from rdstitch.synthetic.panorama import TurningSequence, camera_rotations, panorama_rotations, turning_sequence
from rdstitch.synthetic.poses import Poses, drive_poses, fit_to_plane, grid_poses, pair_poses, survey_poses
from rdstitch.synthetic.relief import RELIEFS, Relief, hills
from rdstitch.synthetic.rendering import Photometry, Sequence, sequence_over
from rdstitch.synthetic.textures import EndlessTexture, ImageTexture, Texture, blank, gradient, ground, repeated

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
    "blank",
    "camera_rotations",
    "drive_poses",
    "fit_to_plane",
    "gradient",
    "grid_poses",
    "ground",
    "hills",
    "pair_poses",
    "panorama_rotations",
    "repeated",
    "sequence_over",
    "survey_poses",
    "turning_sequence",
]
