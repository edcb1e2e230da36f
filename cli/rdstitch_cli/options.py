"""Options that several commands share, each defined once."""

import os
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar, get_args

import click
from click.core import ParameterSource

from rdstitch.choices import FEATURES, CameraFormat, LensName, ModelName, ProjectionName, SolverName
from rdstitch_cli.option_texts import TEXTS, option
from rdstitch_cli.parameter_types import (
    ANGLE,
    ANGLES,
    BYTES,
    CORNERS,
    EPSG,
    EXTENT,
    LINES,
    FileOr,
    RealNumber,
    UserPath,
    WholeNumber,
    word_or_number,
)
from rdstitch_cli.terminal import Reporter

Command = TypeVar("Command", bound=Callable[..., Any])
Decorator = Callable[[Command], Command]

SOLVERS = tuple(name.replace("_", "-") for name in get_args(SolverName))
LENSES, PROJECTIONS, MODELS = get_args(LensName), get_args(ProjectionName), get_args(ModelName)

IMAGE = UserPath()


def together(*options: Callable[[Any], Any]) -> Decorator[Any]:
    """Several options as one decorator, shown in this order."""

    def decorate(command: Any) -> Any:
        for each in reversed(options):
            command = each(command)
        return command

    return decorate


def resolve(inputs: tuple[Path, ...]) -> list[Path]:
    """The inputs, with - replaced by the names on standard input, one a line or separated by NUL."""
    from rdstitch.inputs.find import names_in

    named: list[Path] = []
    for item in inputs:
        listed = names_in(os.fsdecode(sys.stdin.buffer.read())) if str(item) == "-" else [item]
        named.extend(map(Path, listed))
    return named


def is_given(name: str) -> bool:
    """Check whether the user set an option of the running command, rather than left it at its default."""
    return click.get_current_context().get_parameter_source(name) not in (None, ParameterSource.DEFAULT)


inputs = click.argument("inputs", nargs=-1, required=True, type=UserPath(allow_dash=True), metavar="INPUT...")


def _every(otherwise: int | None) -> Decorator[Any]:
    """The option, and what a command takes without it: None for "auto"."""
    usual = "auto" if otherwise is None else otherwise
    return option(
        "--every",
        word_or_number(("auto",), 1, 1_000_000),
        callback=lambda _context, _option, value: {None: otherwise, "auto": None}.get(value, value),
        help=f"{TEXTS['--every'].text}  [default: {usual}]",
    )


every, every_frame = _every(None), _every(1)
topic = option("--topic")
output = option("-o --output", IMAGE, required=True)
overwrite = option("--overwrite", bool)


def as_json(what: str) -> Decorator[Any]:
    """The option, of a command that would print so much."""
    return click.option("--json", "as_json", is_flag=True, help=TEXTS["--json"].text.format(what))


def verbosity(command: Callable[..., Any]) -> Any:
    """-q and -v, by which the command gets its ``reporter``."""

    @option("-q --quiet", bool)
    @option("-v --verbose", bool)
    @wraps(command)
    def run(*, quiet: bool, verbose: bool, **given: Any) -> Any:
        with Reporter(verbose - quiet) as reporter:
            return command(reporter=reporter, **given)

    return run


flat_field, no_flat_field = (option("--flat-field", FileOr("auto", "off"), usual) for usual in ("auto", "off"))
follow = together(option("--follow", bool, dest="following"), option("--idle", RealNumber(0.0, min_open=True)))
distortion = option("--lambda", RealNumber(), dest="distortion")
lens = together(option("--camera", IMAGE), distortion)
known = together(
    lens,
    option("--focal", RealNumber()),
    option("--tilt", ANGLES),
    option("--attitude", FileOr("xmp")),
    option("--attitude-std", ANGLE, "1"),
    option("--timestamps", IMAGE),
    option("--positions", IMAGE),
    option("--positions-offset", RealNumber(), 0.0),
    option("--position-accuracy", RealNumber(0.0, min_open=True)),
)
mask = option("--mask", IMAGE)
workers = option("-j --workers", WholeNumber(0), default=0)
estimation = together(
    mask,
    option("--exclude", multiple=True),
    option("--include-only", multiple=True),
    option("--features", FEATURES, "rootsift"),
    option("--aliked-model", IMAGE),
    option("--lightglue-model", IMAGE),
    option("--max-features", WholeNumber(1)),
    option("--work-megapixels", RealNumber(0.0)),
    option("--solver", SOLVERS, "auto"),
    option("--lens", LENSES, "auto"),
    option("--model", MODELS, "auto"),
    option("--threshold", RealNumber(), 3.0),
    option("--seed", WholeNumber(0), 0),
    option("--cache", IMAGE),
    option("--scheduler"),
    workers,
)
strict = option("--strict", bool)
report = option("--report", IMAGE)
trust = together(strict, option("--force", bool))


blend, cut = (option("--blend", ("none", "feather", "multiband"), usual) for usual in ("multiband", "none"))
crop = option("--crop/--no-crop", default=False, callback=lambda _context, _option, value: "auto" if value else "none")
interpolation = option("--interpolation", ("linear", "cubic", "lanczos"), "cubic")
output_form = together(
    option("--background", WholeNumber(0, 255), 0),
    option("--max-memory", BYTES),
    option("--scale", RealNumber(), 1.0),
    option("--max-size", WholeNumber(1)),
    option("--quality", WholeNumber(1, 100), 95),
    option("--dry-run", bool),
)
compositing = together(
    option("--exposure", ("auto", "none", "exif", "gain", "blocks", "balanced"), "auto"),
    option("--seam", ("none", "voronoi", "graphcut"), "graphcut"),
    blend,
    crop,
    option("--projection", PROJECTIONS, "auto"),
    option("--rectangle", CORNERS),
    option("--straighten", LINES, "off"),
    option("--level", bool),
    *(option(name, RealNumber(), 0.0) for name in ("--yaw", "--pitch", "--roll")),
    interpolation,
    output_form,
    option("--max-stretch", RealNumber(1.0, min_open=True), 3.0),
    option("--rotate", RealNumber(), 0.0),
    option("--north-up/--no-north-up", default=True),
    option("--gsd", RealNumber()),
    option("--crs", EPSG, dest="epsg"),
    option("--like", IMAGE, callback=lambda _context, _option, value: None if value is None else str(value)),
    option("--extent", EXTENT),
    option("--georeference", ("auto", "force", "off"), "auto"),
)

camera_format = option("--camera-format", get_args(CameraFormat), "auto")

# What every command that registers images takes, and what those take that also compose them.
registration = together(overwrite, known, estimation, report, trust)
stitching = together(
    output,
    option("--reference"),
    option("--preview", bool),
    option("--local-alignment", word_or_number(("auto", "off"), 2, 100), "auto"),
    compositing,
    option("--gcp", IMAGE),
    option("--check-points", IMAGE),
    option("--layers", IMAGE),
    option("--whole-layers", bool),
    option("--hugin-project", IMAGE),
    option("--save-camera", IMAGE),
    camera_format,
    registration,
    as_json("the sidecar"),
    verbosity,
)
