"""The recipes that make a picture, a camera or a trajectory out of pictures."""

from rdstitch.pipeline.options import StitchOptions
from rdstitch.pipeline.recipes import pano
from rdstitch.pipeline.result import StitchResult
from rdstitch.pipeline.undistortion import undistort

__all__ = ["StitchOptions", "StitchResult", "pano", "undistort"]
