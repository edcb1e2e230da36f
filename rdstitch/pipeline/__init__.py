"""The recipes that make an image, a camera or a trajectory out of images."""

from rdstitch.options import StitchOptions
from rdstitch.pipeline.apply_sidecar import apply
from rdstitch.pipeline.composer import Composer
from rdstitch.pipeline.hugin_project import project_of_hugin
from rdstitch.pipeline.layers import write_layers
from rdstitch.pipeline.poses import PosesFrame, poses_table
from rdstitch.pipeline.recipes import calibrate, mosaic, mosaic_blocks, pano, trajectory
from rdstitch.pipeline.recomposition import Recomposition
from rdstitch.pipeline.stage_tiles import place_tiles, tiles
from rdstitch.pipeline.undistort_images import undistort
from rdstitch.registration import Registration
from rdstitch.stitch_result import StitchResult

__all__ = [
    "Composer",
    "PosesFrame",
    "Recomposition",
    "Registration",
    "StitchOptions",
    "StitchResult",
    "apply",
    "calibrate",
    "mosaic",
    "mosaic_blocks",
    "pano",
    "place_tiles",
    "poses_table",
    "project_of_hugin",
    "tiles",
    "trajectory",
    "undistort",
    "write_layers",
]
