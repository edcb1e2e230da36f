"""Ground truth: rendered image sequences, for tests, examples and benchmarks."""

from rdstitch.synthetic.lenses import BrownLens, FisheyeLens, Lens
from rdstitch.synthetic.poses import Poses, fit_to_plane, grid_poses, pair_poses
from rdstitch.synthetic.relief import RELIEFS, Relief, buildings, bumps, slopes
from rdstitch.synthetic.rendering import Photometry, RenderedSequence, sequence_over
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
    "RenderedSequence",
    "Texture",
    "blank",
    "buildings",
    "bumps",
    "fit_to_plane",
    "gradient",
    "grid_poses",
    "ground",
    "pair_poses",
    "repeated",
    "sequence_over",
    "slopes",
]
