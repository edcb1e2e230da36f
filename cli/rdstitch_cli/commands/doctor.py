"""``rdstitch doctor``: what will happen, before a long run."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import click

from rdstitch.options.option import Option
from rdstitch.options.shared_options import Every, Topic
from rdstitch.results.messages import bytes_in_words, seconds_in_words, shortened
from rdstitch_cli.flags import Inputs, command
from rdstitch_cli.stitching import resolve
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.pipeline.doctor import Examination


@command(
    """
  rdstitch doctor flight/
  rdstitch doctor drive.mp4 --json
"""
)
def doctor(
    inputs: Inputs,
    every: Every = None,
    topic: Topic = None,
    as_json: Annotated[bool, Option("Print what was found as JSON.", flag="--json")] = False,
    *,
    reporter: Reporter,
) -> None:
    """Find out what a run will meet, and what to change before it.

    INPUT is what 'rdstitch mosaic' takes. Shown are sizes, cameras and zooms by EXIF, blur, exposure, and, by a dry run
    on small versions of the images, overlap, size of the mosaic, and memory and time of compositing it. Nothing is
    written.
    """
    from rdstitch.pipeline.doctor import examine
    from rdstitch.system.outputs import json_bytes

    found = examine(resolve(inputs), every=every, topic=topic, progress=reporter)
    reporter.finish()
    click.echo(json_bytes(_record(found)) if as_json else _text(found), nl=False)


def _record(found: "Examination") -> dict[str, Any]:
    """What was found, for JSON."""
    record = {name: value for name, value in asdict(found).items() if name not in ("focal_px", "zoomed", "problems")}
    words = {"sizes": _sizes(found), "cameras": _cameras(found), "focal": _focal(found), "advice": found.advice}
    order = "images unreadable sizes cameras focal blurred dark burnt alone overlap plan advice"
    return {name: (record | words)[name] for name in order.split()}


def _text(found: "Examination") -> str:
    """What was found, one line for each thing, advice at the end."""

    def few(names: Sequence[str], what: str, none: str) -> str:
        return f"{len(names)} {what}: {shortened(names)}" if names else none

    overlap = "none found" if found.overlap is None else f"about {found.overlap:.0%} with the best partner"
    effort = "no mosaic is to be expected"
    if (plan := found.plan) is not None:
        effort = "{} x {} pixels; about {} of memory and {} to composite them".format(
            *plan.canvas_size, bytes_in_words(plan.memory_bytes), seconds_in_words(plan.seconds)
        )
    lines = [
        ("images", f"{found.images}" + (f", and {len(found.unreadable)} unreadable" if found.unreadable else "")),
        ("sizes", "; ".join(f"{size} ({count})" for size, count in _sizes(found))),
        ("cameras", "; ".join(f"{camera} ({count})" for camera, count in _cameras(found))),
        ("focal", _focal(found)),
        ("sharpness", few(found.blurred, "blurred", "nothing blurred")),
        (
            "exposure",
            f"{few(found.dark, 'dark', 'nothing dark')}; {few(found.burnt, 'burnt out', 'nothing burnt out')}",
        ),
        ("overlap", f"{overlap}; {few(found.alone, 'without a place', 'every image has a place')}"),
        ("mosaic", effort),
        *(("advice", item) for item in found.advice or ("none: go ahead",)),
    ]
    return "".join(f"{name + ':':<12}{text}\n" for name, text in lines)


def _sizes(found: "Examination") -> list[tuple[str, int]]:
    return [("{} x {}".format(*size), count) for size, count in found.sizes]


def _cameras(found: "Examination") -> list[tuple[str, int]]:
    return [(camera or "unknown", count) for camera, count in found.cameras]


def _focal(found: "Examination") -> str:
    if not found.focal_px:
        return "not known from EXIF; it is guessed, which matters for trajectory only"
    text = f"{min(found.focal_px):.0f}" + (f" to {max(found.focal_px):.0f}" if found.zoomed else "")
    return f"{text} pixels by EXIF in {len(found.focal_px)} of {found.images} images"
