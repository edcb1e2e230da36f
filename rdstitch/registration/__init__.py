"""From pairs of pictures to all of them registered as one."""

from rdstitch.registration.align import AlignmentOptions, align
from rdstitch.registration.alignment import Alignment
from rdstitch.registration.links import Link
from rdstitch.registration.models import MODELS

__all__ = ["MODELS", "Alignment", "AlignmentOptions", "Link", "align"]
