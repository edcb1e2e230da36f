"""What the stitching commands share: from flags to options, from a result to lines."""

import os
import shlex
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from rdstitch.options.composite_options import CompositeOptions
from rdstitch.options.feature_options import FeatureOptions
from rdstitch.options.files_beside import FilesBeside
from rdstitch.options.option import Option
from rdstitch.options.stitch_options import PREVIEW, StitchOptions
from rdstitch.results.messages import bytes_in_words, seconds_in_words
from rdstitch_cli.flags import flags_of, is_given, values_of
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.compositing import CompositePlan
    from rdstitch.results.registration import Registration
    from rdstitch.results.stitch_result import StitchResult
    from rdstitch.sidecar.recomposition import Recomposition

Preview = Annotated[
    bool,
    Option(
        "A quick draft of at most 1200 pixels: few features of reduced images, straight seams; options "
        "given take precedence."
    ),
]
STITCHING = [*flags_of(StitchOptions, without="odometry"), *flags_of(FeatureOptions), *flags_of(CompositeOptions)]
"""The options of every command that composes the images that it registers."""


def resolve(inputs: tuple[Path | str, ...]) -> list[Path | str]:
    """The inputs, with - replaced by the names on standard input, one a line or separated by NUL; URLs stay text."""
    from rdstitch.inputs.arguments import names_in

    named: list[Path | str] = []
    for item in inputs:
        named += names_in(os.fsdecode(sys.stdin.buffer.read())) if str(item) == "-" else [item]
    return named


def stitch_options(given: Mapping[str, Any], *, preview: bool = False, **more: Any) -> StitchOptions:
    """The library's options from a command's flags."""
    if preview:
        sized = is_given("like") or is_given("extent")
        left = [name for name in PREVIEW if not (is_given(name) or (sized and name == "max_size"))]
        given = {**given, **{name: PREVIEW[name] for name in left}}
    more |= {
        "features": FeatureOptions(**values_of(FeatureOptions, given)),
        "composite": CompositeOptions(**values_of(CompositeOptions, given)),
    }
    return StitchOptions(**{**values_of(StitchOptions, given), **more})


def files_beside(given: Mapping[str, Any]) -> FilesBeside:
    """What is written beside a result, from a command's flags."""
    return FilesBeside(**values_of(FilesBeside, given), command=shlex.join(["rdstitch", *sys.argv[1:]]))


def report_result(result: "StitchResult", reporter: Reporter, *, as_json: bool, more: str = "") -> None:
    """λ and the plan of a dry run, or the sidecar, to standard output; all else to standard error."""
    from rdstitch.sidecar.write import sidecar

    report_registration(result.registration, reporter, partial(sidecar, result) if as_json else None)
    places, broken = len(result.seams.places), int(result.seams.broken.sum())
    reporter.log(f"seams hold at {places - broken} of {places} places")
    for one in result.seams.breaks:
        first, second = (result.registration.used_names[k] for k in one.images)
        x, y = one.position
        reporter.log(f"broken over {one.length:.0f} pixels at ({x:.0f}, {y:.0f}), between {first} and {second}")
    if result.plan is None:
        reporter.made(f"{result.summary}{more}")
    elif not as_json:
        show_plan(result.plan)


def report_applied(result: "Recomposition", reporter: Reporter) -> None:
    """What the user must know of images that were applied, and what was made of them, or would be."""
    from rdstitch.results.messages import merge_by_reason

    reporter.finish()
    for missing in merge_by_reason(result.left_out.values()):
        reporter.warn(str(missing))
    for message in result.messages:
        reporter.tell(message)
    if result.plan is not None:
        show_plan(result.plan)
    else:
        reporter.made(result.summary)


def show_plan(plan: "CompositePlan") -> None:
    """What compositing would take, to standard output."""
    (width, height), megapixels = plan.canvas_size, plan.canvas_size[0] * plan.canvas_size[1] / 1e6
    click.echo(f"images: {plan.images}")
    click.echo(f"canvas: {width} x {height} pixels, {megapixels:.4g} megapixels")
    click.echo(f"output: {bytes_in_words(plan.output_bytes)} of samples, before compression")
    click.echo(
        f"memory: about {bytes_in_words(plan.memory_bytes)} for {plan.workers} tiles of side {plan.tile_size} at a time"
    )
    click.echo(f"time: about {seconds_in_words(plan.seconds)} for compositing")


def report_registration(
    registration: "Registration", reporter: Reporter, content: Callable[[], Any] | None = None
) -> None:
    """λ, nan where it is not observable, or some content as JSON to standard output; warnings to standard error."""
    from rdstitch.system.outputs import json_bytes

    reporter.finish()
    warn_of(registration, reporter)
    alignment = registration.alignment
    if content is not None:
        click.echo(json_bytes(content()), nl=False)
    else:
        click.echo(f"{alignment.distortion:.6f}" if alignment.lens_observable else "nan")


def warn_of(registration: "Registration", reporter: Reporter) -> None:
    """What the user must know of a registration."""
    from rdstitch.results.messages import merge_by_reason, of_severity

    alignment = registration.alignment
    for message in merge_by_reason((*registration.failures, *registration.warnings, *registration.left_out)):
        reporter.warn(str(message))
    for message in (*of_severity(registration.messages, "note"), *of_severity(registration.messages, "detail")):
        reporter.tell(message)
    used = int(alignment.used.sum())
    reporter.log(f"{used} of {len(alignment.used)} images, rms {alignment.rms:.2f} pixels; {alignment.model_reason}")
