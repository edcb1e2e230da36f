"""Local alignment: a smooth residual warp per image, where the scene has depth that no plane and no turn explains."""

from rdstitch.local_alignment.estimate import HeldOut, LocalAlignment, align_locally, no_local_alignment
from rdstitch.local_alignment.field import DisplacementField
from rdstitch.local_alignment.matches import PutativeMatches

__all__ = ["DisplacementField", "HeldOut", "LocalAlignment", "PutativeMatches", "align_locally", "no_local_alignment"]
