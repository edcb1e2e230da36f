"""From pairs of images to all of them registered as one."""

from rdstitch.alignment.alignment_options import AlignmentOptions
from rdstitch.alignment.lens.lens_selection import LENSES
from rdstitch.alignment.motion_models import MODELS
from rdstitch.alignment.recipe import AlignmentTask, align, most_matches_read
from rdstitch.alignment.result import Alignment
from rdstitch.matching.links import Link

__all__ = [
    "LENSES",
    "MODELS",
    "Alignment",
    "AlignmentOptions",
    "AlignmentTask",
    "Link",
    "align",
    "most_matches_read",
]
