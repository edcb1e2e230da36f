"""Options that several commands share, each defined once."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from rdstitch_cli.parameter_types import Angle, Angles, Bytes, FileOr, UserPath, WordOrNumber

Command = TypeVar("Command", bound=Callable[..., Any])
Decorator = Callable[[Command], Command]

FEATURES = ("rootsift", "sift", "surf", "orb", "akaze", "kaze", "brisk", "aliked")
SOLVERS = ("auto", "two-point", "three-point", "three-point-similarity", "four-point", "five-point")
LENSES = ("auto", "division", "division-center", "division2", "division3")
MODELS = ("auto", "rigid", "similarity", "tilting", "pose", "homography", "rotation")

PICTURE = UserPath()


def together(*options: Callable[[Any], Any]) -> Decorator[Any]:
    """Several options as one decorator, shown in this order."""

    def decorate(command: Any) -> Any:
        for option in reversed(options):
            command = option(command)
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
    """Whether the user set an option of the running command, rather than left it at its default."""
    return click.get_current_context().get_parameter_source(name) not in (None, ParameterSource.DEFAULT)


inputs = click.argument(
    "inputs",
    nargs=-1,
    required=True,
    type=UserPath(allow_dash=True),
    metavar="INPUT...",
)


def _every(otherwise: int | None) -> Decorator[Any]:
    """The option, and what a command takes without it: None for "auto"."""
    return click.option(
        "--every",
        type=WordOrNumber(("auto",), 1, 1_000_000),
        callback=lambda _context, _option, value: {None: otherwise, "auto": None}.get(value, value),
        metavar="auto|N",
        help="Of a video or ROS bag, every N-th frame; auto: those that show new ground.  [default: auto; of "
        "trajectory and apply 1]",
    )


every, every_frame = _every(None), _every(1)

topic = click.option("--topic", metavar="NAME", help="Of a ROS bag, the topic of its images.")

output = click.option(
    "-o", "--output", type=PICTURE, required=True, help="Picture to write: .jpg, .png, .tif, .webp or .dzi."
)

overwrite = click.option("--overwrite", is_flag=True, help="Replace existing output files.")

as_json = click.option(
    "--json", "as_json", is_flag=True, help="Print everything as JSON: the sidecar, the camera, or what doctor found."
)

verbosity = together(
    click.option("-q", "--quiet", is_flag=True, help="Say nothing on standard error but errors."),
    click.option("-v", "--verbose", is_flag=True, help="Say what is going on."),
)

lens = together(
    click.option(
        "--camera",
        type=PICTURE,
        metavar="FILE",
        help="Camera file of rdstitch, OpenCV, ROS, Kalibr, COLMAP, OpenDroneMap or Hugin; its lens is kept.",
    ),
    click.option(
        "--lambda", "distortion", type=float, metavar="L", help="Known λ for half the image diagonal; it is kept."
    ),
)

known = together(
    lens,
    click.option("--focal", type=float, metavar="PX", help="Focal length, pixels; otherwise from EXIF, else guessed."),
    click.option("--tilt", type=Angles(), help="Known tilt of the camera to the plane, degrees."),
    click.option(
        "--attitude",
        type=FileOr("xmp"),
        metavar="FILE|xmp",
        help="Tilt of each picture: CSV name,psi,theta in degrees; xmp: what drones write into their pictures.",
    ),
    click.option(
        "--attitude-std",
        type=Angle(),
        default="1",
        show_default=True,
        help="Standard deviation of the attitudes, degrees; 0 for exact ones.",
    ),
)

mask = click.option(
    "--mask",
    type=PICTURE,
    metavar="DIR|FILE",
    help="Black is excluded: a folder of masks with the pictures' names, or one mask for all pictures.",
)

workers = click.option(
    "-j", "--workers", type=click.IntRange(0), default=0, help="Threads; 0, the default, is one for each core."
)

estimation = together(
    mask,
    click.option(
        "--exclude",
        multiple=True,
        metavar="NAME",
        help="Leave out the picture of this name, or all that fit a pattern like 'img_49*'; repeatable.",
    ),
    click.option(
        "--include-only",
        multiple=True,
        metavar="NAME",
        help="Use only the pictures of this name or pattern; repeatable.",
    ),
    click.option(
        "--features", type=click.Choice(FEATURES), default="rootsift", show_default=True, help="Features to match."
    ),
    click.option("--aliked-model", type=PICTURE, metavar="FILE", help="ONNX file of the network of --features aliked."),
    click.option(
        "--lightglue-model", type=PICTURE, metavar="FILE", help="Match by this LightGlue network for these features."
    ),
    click.option(
        "--max-features",
        type=click.IntRange(1),
        metavar="N",
        help="At most so many features a picture.  [default: 2000; of fewer than 8 pictures 16000 together, "
        "at most 4000 each]",
    ),
    click.option(
        "--work-megapixels",
        type=click.FloatRange(0.0),
        metavar="MP",
        help="Pictures are halved until they have no more megapixels before features are detected, once less where "
        "that shows too few; 0 is full size.  [default: 0.6; of fewer than 8 pictures 4.8 together, at most 2.4 each]",
    ),
    click.option(
        "--solver", type=click.Choice(SOLVERS), default="auto", show_default=True, help="Minimal solver of the pairs."
    ),
    click.option(
        "--lens",
        type=click.Choice(LENSES),
        default="auto",
        show_default=True,
        help="Lens to estimate: λ; λ and the distortion centre; besides them a second or a third coefficient.",
    ),
    click.option(
        "--model", type=click.Choice(MODELS), default="auto", show_default=True, help="How freely the camera moved."
    ),
    click.option(
        "--threshold",
        type=float,
        default=3.0,
        show_default=True,
        metavar="PX",
        help="Largest error of an inlier, pixels of the size that features are detected at (see --work-megapixels).",
    ),
    click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of random sampling."),
    click.option(
        "--cache",
        type=PICTURE,
        metavar="DIR",
        help="Keep features, pairs and alignments in this folder, and continue from what is there; made if missing.",
    ),
    click.option(
        "--scheduler",
        metavar="ADDRESS|local",
        help="Let a Dask cluster do the work, whose machines see the pictures and the folder of --cache; local starts "
        "one here.",
    ),
    workers,
)

strict = click.option("--strict", is_flag=True, help="Fail with status 5 when a picture is left out.")

report = click.option(
    "--report",
    type=PICTURE,
    metavar="FILE",
    help="Write a report to FILE (.html): graph, votes on λ, matches, residuals.",
)

trust = together(
    strict,
    click.option("--force", is_flag=True, help="Write the result even when it fails its own checks."),
)

compositing = together(
    click.option(
        "--exposure",
        type=click.Choice(["none", "gain", "blocks", "balanced"]),
        default="balanced",
        show_default=True,
        help="Brightness: balanced leaves no step at seams, keeps every region near its own pictures' brightness and "
        "clips nothing; gain makes the whole comparable (one factor per picture, one vignetting); blocks adds a "
        "smooth field per picture to that.",
    ),
    click.option(
        "--seam",
        type=click.Choice(["none", "voronoi", "graphcut"]),
        default="graphcut",
        show_default=True,
        help="Where pictures meet: round what differs, midway, or wherever they overlap.",
    ),
    click.option(
        "--blend",
        type=click.Choice(["none", "feather", "multiband"]),
        default="multiband",
        show_default=True,
        help="How pictures pass into one another; none cuts, for measuring.",
    ),
    click.option(
        "--crop",
        type=click.Choice(["none", "auto"]),
        default="none",
        show_default=True,
        help="Cut to the largest rectangle without holes.",
    ),
    click.option(
        "--projection",
        type=click.Choice(["auto", "plane", "cylinder", "sphere", "mercator"]),
        default="auto",
        show_default=True,
        help="How pictures taken by turning on the spot are laid out.",
    ),
    click.option(
        "--interpolation",
        type=click.Choice(["linear", "cubic", "lanczos"]),
        default="cubic",
        show_default=True,
        help="Kernel of the one resampling.",
    ),
    click.option(
        "--background",
        type=click.IntRange(0, 255),
        default=0,
        show_default=True,
        metavar="GREY",
        help="What no picture covers, in JPEG and .dzi: 0 black to 255 white.",
    ),
    click.option(
        "--max-memory",
        type=Bytes(),
        help="Memory that compositing may take, as 800M; otherwise up to 256M, or more for a large canvas.",
    ),
    click.option(
        "--scale",
        type=float,
        default=1.0,
        show_default=True,
        help="Factor to the size of the output; 1 keeps resolution.",
    ),
    click.option(
        "--max-stretch",
        type=click.FloatRange(1.0, min_open=True),
        default=3.0,
        show_default=True,
        metavar="N",
        help="What an oblique picture shows N times coarser than the reference picture is not drawn.",
    ),
    click.option(
        "--max-size",
        type=click.IntRange(1),
        metavar="N",
        help="Longest side of the output, pixels; smaller than --scale makes it where that is more.",
    ),
    click.option(
        "--quality",
        type=click.IntRange(1, 100),
        default=95,
        show_default=True,
        metavar="Q",
        help="Quality of JPEG and WebP, 1 to 100.",
    ),
    click.option(
        "--rotate",
        type=float,
        default=0.0,
        show_default=True,
        metavar="DEG",
        help="Turn the output clockwise, degrees.",
    ),
    click.option(
        "--dry-run", is_flag=True, help="Say what compositing would take (size, memory, time); write nothing."
    ),
)

# What every command that registers pictures takes, and what those take that also compose them.
registration = together(overwrite, known, estimation, report, trust, as_json, verbosity)

stitching = together(
    output,
    click.option("--reference", metavar="NAME", help="Picture that sets the frame; otherwise the best connected one."),
    click.option(
        "--preview",
        is_flag=True,
        help="A quick small picture: at most 1200 pixels, few features of small versions of the pictures, straight "
        "seams; options that are given stay as they are.",
    ),
    click.option(
        "--local-alignment",
        type=WordOrNumber(("auto", "off"), 2, 100),
        metavar="auto|off|N",
        default="auto",
        show_default=True,
        help="Where the ground is not quite a plane, bring pictures together by a smooth displacement of each: auto "
        "where matches that took no part in it come nearer; a number of cells along a picture's longer side: always.",
    ),
    compositing,
    click.option(
        "--save-camera",
        type=PICTURE,
        metavar="FILE",
        help="Write the estimated camera: .json, .yml (OpenCV), .pto (Hugin), camera_info.yaml (ROS) and others.",
    ),
    registration,
)
