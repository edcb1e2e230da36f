"""What stitching gives."""

from dataclasses import dataclass
from pathlib import Path

from rdstitch.compositing import Canvas, Composite, CompositePlan
from rdstitch.options import StitchOptions
from rdstitch.registration import Registration
from rdstitch.verification.verdict import Verdict


@dataclass(frozen=True)
class StitchResult:
    """A stitched picture and everything that was estimated for it.

    Attributes
    ----------
    registration : Registration
    canvas : Canvas
        Where the pictures lie in the output.
    verdict : Verdict
        Whether the result passed its own checks.
    options : StitchOptions
    output : Path or None
        File that the picture was written to.
    composite : Composite or None
        The picture itself; None where it went to a file, or was only planned.
    plan : CompositePlan or None
        Of a dry run.
    notes : tuple of str
        What the user should know of the compositing.
    """

    registration: Registration
    canvas: Canvas
    verdict: Verdict
    options: StitchOptions
    output: Path | None = None
    composite: Composite | None = None
    plan: CompositePlan | None = None
    notes: tuple[str, ...] = ()

    @property
    def distortion(self) -> float:
        """λ in the half-diagonal frame."""
        return self.registration.alignment.distortion

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know although there is a result, one sentence each."""
        return (*self.registration.alignment.warnings, *self.verdict.doubts, *self.notes)
