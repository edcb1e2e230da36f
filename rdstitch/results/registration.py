"""What registering a set of images gives."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from rdstitch.alignment import Alignment
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.exif_orientation import inverse
from rdstitch.inputs.source import Source
from rdstitch.matching.mixed_lenses import TwoLenses
from rdstitch.matching.two_view import PairRegistration
from rdstitch.results.messages import Message, of_severity

if TYPE_CHECKING:
    from rdstitch.stage.register_tiles import TileRegistration


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be relied on."""

    ok: bool  # whether it passed its own checks
    failures: tuple[str, ...] = ()  # why it did not
    warnings: tuple[str, ...] = ()  # what to look at


@dataclass(frozen=True, repr=False)
class Registration:
    """Images registered as one.

    Attributes
    ----------
    sources : tuple of Source
    keypoints : tuple of int
        Number of features of each image.
    pairs : tuple of PairRegistration
        Every pair that was compared.
    alignment : Alignment
    messages : tuple of Message
        What the user should know: failed checks, warnings, and every image that is not in the result.
    static_background : bool
        Whether a part of what the images show stays where it is in them, and only what moves was registered.
    stretch : (float, float) or None
        Grey levels of all images that count as black and white; None for those of 8 bits.
    tiles : TileRegistration or None
        Of tiles on a stage: what the stage does, and which tiles have their places from it alone.
    mixed : TwoLenses or None
        Where images of two lenses are mixed. If it is clear which belong together, the others are left out.
    """

    sources: tuple[Source, ...]
    keypoints: tuple[int, ...]
    pairs: tuple[PairRegistration, ...]
    alignment: Alignment
    messages: tuple[Message, ...]
    static_background: bool = False
    mixed: TwoLenses | None = None
    stretch: tuple[float, float] | None = None
    tiles: "TileRegistration | None" = None

    def __repr__(self) -> str:
        return f"<Registration {self.summary}>"

    def with_messages(self, messages: Iterable[Message]) -> Self:
        """The same with more to know about it."""
        return replace(self, messages=(*self.messages, *messages))

    @property
    def ok(self) -> bool:
        """Whether it passed its checks."""
        return not self.failures

    @property
    def verdict(self) -> Verdict:
        """The same, with failures and warnings in words."""
        clauses = ([message.clause for message in messages] for messages in (self.failures, self.warnings))
        return Verdict(self.ok, *map(tuple, clauses))

    @property
    def failures(self) -> tuple[Message, ...]:
        """Why the result cannot be relied on; empty if :attr:`ok`."""
        return of_severity(self.messages, "failure")

    @property
    def warnings(self) -> tuple[Message, ...]:
        """What the user should look at although there is a result."""
        return of_severity(self.messages, "warning")

    @property
    def left_out(self) -> tuple[Message, ...]:
        """Every image that is not in the result, with the reason."""
        return of_severity(self.messages, "left out")

    @property
    def used_names(self) -> list[str]:
        """Of the images that are in the result."""
        return [source.name for source, used in zip(self.sources, self.alignment.used, strict=True) if used]

    @property
    def used_pairs(self) -> list[PairRegistration]:
        """Every pair of images that are in the result."""
        used = self.alignment.used
        return [pair for pair in self.pairs if used[pair.image1] and used[pair.image2]]

    @property
    def summary(self) -> str:
        """How many images are in the result, and λ with its standard deviation, in one line."""
        used = int(self.alignment.used.sum())
        images = f"{used} of {used + len(self.left_out)} images"
        if self.tiles is not None:
            linked = int(self.tiles.linked.sum())
            alone = f", {used - linked} by the stage alone" if linked < used else ""
            images = f"{linked} of {used + len(self.left_out)} images registered{alone}"
        return f"{images}, λ {'= ' if self.alignment.lens_observable else ''}{self.distortion_in_words(4)}"

    def distortion_in_words(self, digits: int) -> str:
        """λ, to so many digits, with its standard deviation or why it has none."""
        alignment = self.alignment
        if not alignment.lens_observable:
            return "not observable"
        error = f"({alignment.lens_reason})" if alignment.lens_given else f"± {alignment.distortion_std:.{digits}f}"
        return f"{alignment.distortion:.{digits}f} {error}"

    @property
    def upright_camera(self) -> Camera:
        """The camera of the reference image as its pixels are read, upright."""
        return self.alignment.cameras[self.alignment.reference]

    @property
    def camera(self) -> Camera:
        """The camera of the reference image as its file stores it, with everything that was found of it."""
        orientation = self.sources[self.alignment.reference].metadata.orientation
        return self.upright_camera.turned(inverse(orientation))
