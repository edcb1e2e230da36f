"""What registering a set of pictures gives."""

from dataclasses import dataclass

from rdstitch.alignment import Alignment
from rdstitch.camera import Camera
from rdstitch.inputs.source import LeftOut, Source
from rdstitch.matching.mixed_lenses import TwoLenses
from rdstitch.matching.two_view import PairRegistration


@dataclass(frozen=True)
class Registration:
    """Pictures registered as one.

    Attributes
    ----------
    sources : tuple of Source
    keypoints : tuple of int
        Number of features of each picture.
    pairs : tuple of PairRegistration
        Every pair that was looked at.
    alignment : Alignment
    left_out : tuple of LeftOut
        Every file that is not in the result, with the reason.
    resting : bool
        Whether most of what the pictures show stays where it is in them, and only what moves was registered.
    mixed : TwoLenses or None
        Where pictures of two lenses are mixed. If it is clear which belong together, the others are left out.
    """

    sources: tuple[Source, ...]
    keypoints: tuple[int, ...]
    pairs: tuple[PairRegistration, ...]
    alignment: Alignment
    left_out: tuple[LeftOut, ...]
    resting: bool = False
    mixed: TwoLenses | None = None

    @property
    def camera(self) -> Camera:
        """The camera of the reference picture, with everything that was found of it."""
        return self.alignment.cameras[self.alignment.reference]
