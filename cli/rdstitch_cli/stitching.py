"""What the stitching commands share: from flags to options, from a result to lines."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rdstitch_cli.progress import Reporter

if TYPE_CHECKING:
    from rdstitch.pipeline import StitchOptions, StitchResult


def stitch_options(
    *,
    camera: Path | None,
    features: str,
    max_features: int | None,
    work_megapixels: float | None,
    solver: str,
    **given: Any,
) -> "StitchOptions":
    """The library's options from a command's flags."""
    from rdstitch.camera import Camera
    from rdstitch.compositing import CompositeOptions
    from rdstitch.features import FeatureOptions
    from rdstitch.pipeline import StitchOptions

    wanted: dict[str, Any] = {"kind": features}
    if max_features is not None:
        wanted["max_features"] = max_features
    if work_megapixels is not None:
        wanted["work_megapixels"] = work_megapixels or None
    composite = {name: given.pop(name) for name in CompositeOptions.__dataclass_fields__ if name in given}
    return StitchOptions(
        camera=None if camera is None else Camera.load(camera),
        features=FeatureOptions(**wanted),
        composite=CompositeOptions(**composite),
        solver=solver.replace("-", "_"),
        **given,
    )


def summarize(result: "StitchResult", reporter: Reporter) -> None:
    """λ to standard output; what the user must know to standard error."""
    for warning in result.warnings:
        reporter.warn(warning)
    for missing in result.registration.left_out:
        reporter.warn(f"left out {missing.path}: {missing.reason}")
    alignment = result.registration.alignment
    used = int(alignment.used.sum())
    reporter.log(f"{used} of {len(alignment.used)} pictures, rms {alignment.rms:.2f} px; {alignment.model_reason}")
    if alignment.distortion_std == float("inf"):
        reporter.warn("λ is not observable in these pictures; 0 was assumed")
    click.echo("nan" if alignment.distortion_std == float("inf") else f"{result.distortion:.6f}")
