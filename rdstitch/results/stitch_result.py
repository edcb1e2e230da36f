"""What stitching gives: the image, in memory or in a file, and everything that was estimated for it."""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing import Canvas, Composite, CompositePlan, FileComposite, SeamQuality
from rdstitch.errors import ArgumentError
from rdstitch.georeferencing.georeference import Georeference
from rdstitch.inputs.frame import to_channel_order
from rdstitch.io.fingerprint import Fingerprint
from rdstitch.io.preview import encode_preview, read_preview
from rdstitch.io.read import read_image
from rdstitch.local_alignment import LocalAlignment, no_local_alignment
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.results.messages import Message
from rdstitch.results.placed_images import PlacedImages
from rdstitch.results.registration import Registration, Verdict

_PREVIEW = 800  # pixels of the longer side


@dataclass(frozen=True, repr=False, kw_only=True)
class OutputImage:
    """An image that was put together, or the plan of doing so; base of all results that have one.

    Attributes
    ----------
    placed : PlacedImages
        The images that are in the output.
    canvas : Canvas
        Where they lie in it.
    options : StitchOptions
    output : Path or None
        File that the image was written to.
    composite : Composite or None
        The image itself; None where it went to a file, or was only planned.
    plan : CompositePlan or None
        Of a dry run.
    written : FileComposite or None
        What was found while the file was written.
    georeference : Georeference or None
        Where the output lies on the Earth.
    not_georeferenced : str
        Why that is not known; empty where it is.
    seams : SeamQuality
        Where seams hold and where they break; empty without seams.
    """

    placed: PlacedImages
    canvas: Canvas
    options: StitchOptions
    output: Path | None = None
    composite: Composite | None = None
    plan: CompositePlan | None = None
    written: FileComposite | None = None
    georeference: Georeference | None = None
    not_georeferenced: str = "not tried"
    seams: SeamQuality = field(default_factory=SeamQuality)

    @property
    def fields(self) -> dict[str, Any]:
        """All of these by name, for a result that has the same image."""
        return {each.name: getattr(self, each.name) for each in fields(OutputImage)}

    @property
    def fingerprint(self) -> Fingerprint | None:
        """Size and digest of the file."""
        return None if self.written is None else self.written.fingerprint

    @property
    def summary(self) -> str:
        """What was made, in one line."""
        name, (width, height) = "" if self.output is None else f"{self.output}: ", self.canvas.size
        return f"{name}{width} x {height} pixels"

    @property
    def image(self) -> NDArray[Any]:
        """The image (H, W) or (H, W, C), channels in the order that was chosen for arrays; 0 where there is none.

        An image that went to a file is read from there.
        """
        return to_channel_order(self._samples()[0], self.options.channel_order)

    @property
    def alpha(self) -> NDArray[np.uint8]:
        """255 where the image is, (H, W), elsewhere 0; 255 everywhere where its file holds no alpha, as JPEG."""
        pixels, alpha = self._samples()
        return np.full(pixels.shape[:2], 255, np.uint8) if alpha is None else alpha

    def _samples(self) -> tuple[NDArray[Any], NDArray[np.uint8] | None]:
        """In RGB order."""
        if self.composite is not None:
            return self.composite.pixels, self.composite.alpha
        if self.plan is not None:
            raise ArgumentError("a dry run makes no image")
        if self.output is None or self.output.suffix.lower() in (".dzi", ".zarr"):
            raise ArgumentError("there is no image in memory: stitch without an output, or with one of another type")
        image = read_image(self.output)
        return image.pixels, image.alpha

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.summary}>"

    def _repr_png_(self) -> bytes | None:
        """A preview for notebooks; None where there is no image."""
        if self.composite is not None:
            return encode_preview(self.composite.pixels, _PREVIEW, self.composite.alpha, "PNG")
        if self.plan is not None or self.output is None or not self.output.is_file():
            return None
        pixels, alpha = read_preview(self.output, self.canvas.size, _PREVIEW)
        return encode_preview(pixels, _PREVIEW, alpha, "PNG")


@dataclass(frozen=True, repr=False, kw_only=True)
class StitchResult(OutputImage):
    """A stitched image and everything that was estimated for it; also as :class:`OutputImage` has it.

    Attributes
    ----------
    registration : Registration
        With all that there is to know of the result in its ``messages``.
    local_alignment : LocalAlignment
        Displacement fields of the images that are used, in their order.
    """

    registration: Registration
    local_alignment: LocalAlignment = field(default_factory=partial(no_local_alignment, "not tried"))

    @property
    def ok(self) -> bool:
        """Whether the result passed its own checks."""
        return self.registration.ok

    @property
    def verdict(self) -> Verdict:
        """The same, with failures and warnings in words, as the sidecar has it."""
        return self.registration.verdict

    @property
    def distortion(self) -> float:
        """λ in the half-diagonal frame."""
        return self.registration.alignment.distortion

    @property
    def messages(self) -> tuple[Message, ...]:
        """What the user should know: failed checks, warnings, and every image that is not in the result."""
        return self.registration.messages

    def with_messages(self, messages: Iterable[Message]) -> Self:
        """The same with more to know about it."""
        return replace(self, registration=self.registration.with_messages(messages))

    @property
    def summary(self) -> str:
        """What was made, of how many images, and λ with its standard deviation, in one line."""
        return f"{super().summary}, {self.registration.summary}"
