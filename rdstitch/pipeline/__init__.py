"""The recipes that make a picture, a camera or a trajectory out of pictures."""

from rdstitch.pipeline.application import apply
from rdstitch.pipeline.options import StitchOptions
from rdstitch.pipeline.recipes import calibrate, mosaic, pano, trajectory
from rdstitch.pipeline.recomposition import Recomposition
from rdstitch.pipeline.register import Registration
from rdstitch.pipeline.result import StitchResult
from rdstitch.pipeline.undistortion import undistort

__all__ = [
    "Recomposition",
    "Registration",
    "StitchOptions",
    "StitchResult",
    "apply",
    "calibrate",
    "mosaic",
    "pano",
    "trajectory",
    "undistort",
]
