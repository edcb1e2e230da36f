"""What stitching gives."""

from dataclasses import dataclass
from pathlib import Path

from rdstitch.compositing import Canvas, Composite, CompositePlan
from rdstitch.messages import Message
from rdstitch.options import StitchOptions
from rdstitch.registration import Registration


@dataclass(frozen=True)
class StitchResult:
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
    """

    registration: Registration
    canvas: Canvas
    options: StitchOptions
    output: Path | None = None
    composite: Composite | None = None
    plan: CompositePlan | None = None

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
