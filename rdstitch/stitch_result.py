"""What stitching gives."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from rdstitch.compositing import Canvas, Composite, CompositePlan
from rdstitch.inputs.frame import ChannelOrder
from rdstitch.io.fingerprint import Fingerprint
from rdstitch.local_alignment import LocalAlignment, no_local_alignment
from rdstitch.messages import Message
from rdstitch.options import StitchOptions
from rdstitch.output_image import OutputImage
from rdstitch.registration import Registration


@dataclass(frozen=True, repr=False)
class StitchResult(OutputImage):
    """A stitched picture and everything that was estimated for it.

    Attributes
    ----------
    registration : Registration
        With all that there is to know of the result in its ``messages``.
    canvas : Canvas
        Where the pictures lie in the output.
    options : StitchOptions
    output : Path or None
        File that the picture was written to.
    composite : Composite or None
        The picture itself; None where it went to a file, or was only planned.
    plan : CompositePlan or None
        Of a dry run.
    fingerprint : Fingerprint or None
        Size and digest of the file.
    local_alignment : LocalAlignment
        Displacement fields of the pictures that are used, in their order.
    """

    registration: Registration
    canvas: Canvas
    options: StitchOptions
    output: Path | None = None
    composite: Composite | None = None
    plan: CompositePlan | None = None
    fingerprint: Fingerprint | None = None
    local_alignment: LocalAlignment = field(default_factory=partial(no_local_alignment, "not tried"))

    @property
    def ok(self) -> bool:
        """Whether the result passed its own checks."""
        return self.registration.ok

    @property
    def distortion(self) -> float:
        """λ in the half-diagonal frame."""
        return self.registration.alignment.distortion

    @property
    def messages(self) -> tuple[Message, ...]:
        """What the user should know: failed checks, warnings, and every picture that is not in the result."""
        return self.registration.messages

    @property
    def image_order(self) -> ChannelOrder:
        """Order of the channels of :attr:`image`."""
        return self.options.channel_order

    @property
    def summary(self) -> str:
        """What was made, of how many pictures, and λ with its standard deviation, in one line."""
        name, (width, height) = "" if self.output is None else f"{self.output}: ", self.canvas.size
        return f"{name}{width} x {height} pixels, {self.registration.summary}"
