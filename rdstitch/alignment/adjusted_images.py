"""What travels through the recipe of the alignment: images as they are given, and as they are adjusted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rdstitch.alignment.adjustment_problem import Problem
from rdstitch.alignment.alignment_options import AlignmentOptions
from rdstitch.alignment.lens.lens_selection import LensChoice
from rdstitch.alignment.select import ModelChoice
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.camera import Camera
from rdstitch.matching.links import Link
from rdstitch.results.messages import Message


@dataclass(frozen=True, eq=False)
class GivenImages:
    """Images to be aligned."""

    cameras: Sequence[Camera]
    links: Sequence[Link]
    options: AlignmentOptions
    # Images that show next to nothing but what another one does, each with that one, and their links: they are placed
    # by these when all the rest is known
    near_copies: Mapping[int, int] = field(default_factory=dict)
    links_of_copies: Sequence[Link] = ()


@dataclass(frozen=True, eq=False)
class AdjustedImages:
    """What the adjustment found, and what it was made from."""

    given: GivenImages
    images: IntArray  # (N,): the images aligned, ascending; the problem numbers them 0 … N-1
    kept_links: BoolArray  # (L,): links not taken for wrong
    all_links: Problem  # of all links and images, with the matches that they are adjusted by in the end
    problem: Problem  # of those aligned, with the matches that they were adjusted by
    choice: ModelChoice
    lens: LensChoice  # the lens, with the distortion centre if the motion model freed it
    positions_disagree: str = ""  # why the positions were not used; empty where they were, or where there are none
    leverage: Mapping[int | str, float] = field(default_factory=dict)  # see Alignment
    messages: tuple[Message, ...] = ()  # on what was given
    # covariance, lens_covariance: of what was estimated, and of all parameters of a lens; none of a draft
    covariance: FloatArray | None = None
    lens_covariance: FloatArray | None = None
