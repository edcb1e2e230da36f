"""Options that several commands share, each defined once."""

import os
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from rdstitch_cli.parameter_types import (
    ANGLE,
    ANGLES,
    BYTES,
    CORNERS,
    EPSG,
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

FEATURES = ("rootsift", "sift", "surf", "orb", "akaze", "aliked")
SOLVERS = ("auto", "two-point", "three-point", "three-point-similarity", "four-point", "five-point")
LENSES = ("auto", "division", "division-center", "division2", "division3")
MODELS = ("auto", "rigid", "similarity", "tilting", "pose", "homography", "rotation")

IMAGE = UserPath()


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


def _choice(name: str, words: Sequence[str], usual: str, text: str) -> Decorator[Any]:
    """An option that is one of some words."""
    return click.option(name, type=click.Choice(words), default=usual, show_default=True, help=text)


def _number(name: str, kind: Any, usual: float, text: str, called: str | None = None) -> Decorator[Any]:
    """An option that is a number."""
    return click.option(name, type=kind, default=usual, show_default=True, metavar=called, help=text)


def _file(name: str, called: str, text: str) -> Decorator[Any]:
    """An option that names a file or folder."""
    return click.option(name, type=IMAGE, metavar=called, help=text)


inputs = click.argument("inputs", nargs=-1, required=True, type=UserPath(allow_dash=True), metavar="INPUT...")


def _every(otherwise: int | None) -> Decorator[Any]:
    """The option, and what a command takes without it: None for "auto"."""
    usual = "auto" if otherwise is None else otherwise
    return click.option(
        "--every",
        type=word_or_number(("auto",), 1, 1_000_000),
        callback=lambda _context, _option, value: {None: otherwise, "auto": None}.get(value, value),
        metavar="auto|N",
        help=f"Of a video or ROS bag, every N-th frame; auto: those that show new ground.  [default: {usual}]",
    )


every, every_frame = _every(None), _every(1)

topic = click.option("--topic", metavar="NAME", help="Of a ROS bag, the topic of its images.")

output = click.option(
    "-o", "--output", type=IMAGE, required=True, help="Image to write: .jpg, .png, .tif, .webp or .dzi."
)

overwrite = click.option("--overwrite", is_flag=True, help="Replace existing output files.")


def as_json(what: str) -> Decorator[Any]:
    """The option, of a command that would print so much."""
    return click.option("--json", "as_json", is_flag=True, help=f"Print {what} as JSON.")


def verbosity(command: Callable[..., Any]) -> Callable[..., Any]:
    """-q and -v, by which the command gets its ``reporter``."""

    @click.option("-q", "--quiet", is_flag=True, help="Say nothing on standard error but errors.")
    @click.option("-v", "--verbose", is_flag=True, help="Say what is going on.")
    @wraps(command)
    def run(*, quiet: bool, verbose: bool, **given: Any) -> Any:
        with Reporter(verbose - quiet) as reporter:
            return command(reporter=reporter, **given)

    return run


def flat_field(usual: str) -> Decorator[Any]:
    """The option, and what a command does without it."""
    return click.option(
        "--flat-field",
        type=FileOr("auto", "off"),
        default=usual,
        show_default=True,
        metavar="auto|off|FILE",
        help="Take out the illumination that all images share: as they show it, or as FILE has it and, on its second "
        "page, the dark field.",
    )


distortion = click.option(
    "--lambda",
    "distortion",
    type=RealNumber(),
    metavar="L",
    help="Known λ for half the image diagonal; it is kept.",
)

lens = together(
    _file(
        "--camera",
        "FILE",
        "Camera file of rdstitch, OpenCV, ROS, Kalibr, COLMAP, OpenDroneMap or Hugin; its lens is kept.",
    ),
    distortion,
)

known = together(
    lens,
    click.option(
        "--focal", type=RealNumber(), metavar="PX", help="Focal length, pixels; otherwise from EXIF, else guessed."
    ),
    click.option("--tilt", type=ANGLES, help="Known tilt of the camera to the plane, degrees."),
    click.option(
        "--attitude",
        type=FileOr("xmp"),
        metavar="FILE|xmp",
        help="Tilt of each image: CSV name,psi,theta in degrees; xmp: what drones write into their images.",
    ),
    click.option(
        "--attitude-std",
        type=ANGLE,
        default="1",
        show_default=True,
        help="Standard deviation of the attitudes, degrees; 0 for exact ones.",
    ),
    _file(
        "--positions",
        "FILE",
        "Where images were taken, instead of EXIF: CSV name,lat,lon or name,x,y (see --crs), exiftool's -csv or -json, "
        "OpenDroneMap's geo.txt, or a GPX track.",
    ),
    _number(
        "--positions-offset",
        RealNumber(),
        0.0,
        "Seconds to add to the images' times to have those of the GPX track, which are in UTC.",
        "S",
    ),
)

mask = _file(
    "--mask", "DIR|FILE", "Black is excluded: a folder of masks with the images' names, or one mask for all images."
)

workers = click.option(
    "-j", "--workers", type=WholeNumber(0), default=0, help="Threads; 0, the default, is one for each usable core."
)

estimation = together(
    mask,
    click.option(
        "--exclude",
        multiple=True,
        metavar="NAME",
        help="Leave out the image of this name, or all that fit a pattern like 'img_49*'; repeatable.",
    ),
    click.option(
        "--include-only",
        multiple=True,
        metavar="NAME",
        help="Use only the images of this name or pattern; repeatable.",
    ),
    _choice("--features", FEATURES, "rootsift", "Features to match."),
    _file("--aliked-model", "FILE", "ONNX file of the network of --features aliked."),
    _file("--lightglue-model", "FILE", "Match by this LightGlue network for these features."),
    click.option(
        "--max-features",
        type=WholeNumber(1),
        metavar="N",
        help="At most so many features an image.  [default: 2000; of fewer than 8 images 16000 together, "
        "at most 4000 each]",
    ),
    click.option(
        "--work-megapixels",
        type=RealNumber(0.0),
        metavar="MP",
        help="Images are halved until they have no more megapixels before features are detected, once less where "
        "that shows too few; 0 is full size.  [default: 0.6; of fewer than 8 images 4.8 together, at most 2.4 each]",
    ),
    _choice("--solver", SOLVERS, "auto", "Minimal solver of the pairs."),
    _choice(
        "--lens",
        LENSES,
        "auto",
        "Lens to estimate: λ; λ and the distortion centre; besides them a second or a third coefficient.",
    ),
    _choice("--model", MODELS, "auto", "How freely the camera moved."),
    _number(
        "--threshold",
        RealNumber(),
        3.0,
        "Largest error of an inlier, pixels of the size that features are detected at (see --work-megapixels).",
        "PX",
    ),
    _number("--seed", WholeNumber(0), 0, "Seed of random sampling."),
    _file(
        "--cache",
        "DIR",
        "Keep features, pairs and alignments in this folder, and continue from what is there; made if missing.",
    ),
    click.option(
        "--scheduler",
        metavar="ADDRESS|local",
        help="Let a Dask cluster do the work, whose machines see the images and the folder of --cache; local starts "
        "one here.",
    ),
    workers,
)

strict = click.option("--strict", is_flag=True, help="Fail with status 5 when an image is left out.")

report = _file("--report", "FILE", "Write a report to FILE (.html): graph, votes on λ, matches, residuals.")

trust = together(
    strict, click.option("--force", is_flag=True, help="Write the result even when it fails its own checks.")
)


def _blend(usual: str) -> Decorator[Any]:
    """The option, and how a command blends without it."""
    text = "How images pass into one another; none cuts, for measuring."
    return _choice("--blend", ["none", "feather", "multiband"], usual, text)


blend, cut = _blend("multiband"), _blend("none")

crop = click.option(
    "--crop/--no-crop",
    default=False,
    callback=lambda _context, _option, value: "auto" if value else "none",
    help="Cut to the largest rectangle without holes.",
)

interpolation = _choice("--interpolation", ["linear", "cubic", "lanczos"], "cubic", "Kernel of the one resampling.")

output_form = together(
    _number(
        "--background",
        WholeNumber(0, 255),
        0,
        "What no image covers, in JPEG and .dzi: 0 black to 255 white.",
        "GREY",
    ),
    click.option(
        "--max-memory",
        type=BYTES,
        help="Memory that compositing may take, as 800M; otherwise a quarter of what is available, at least 400M.",
    ),
    _number("--scale", RealNumber(), 1.0, "Factor to the size of the output; 1 keeps resolution."),
    click.option(
        "--max-size",
        type=WholeNumber(1),
        metavar="N",
        help="Longest side of the output, pixels; smaller than --scale makes it where that is more.",
    ),
    _number("--quality", WholeNumber(1, 100), 95, "Quality of JPEG and WebP, 1 to 100.", "Q"),
    click.option(
        "--dry-run", is_flag=True, help="Say what compositing would take (size, memory, time); write nothing."
    ),
)

compositing = together(
    _choice(
        "--exposure",
        ["none", "gain", "blocks", "balanced"],
        "balanced",
        "Brightness: balanced leaves no step at seams, keeps every region near its own images' brightness and "
        "clips nothing; gain makes the whole comparable (one factor per image, one vignetting); blocks adds a "
        "smooth field per image to that.",
    ),
    _choice(
        "--seam",
        ["none", "voronoi", "graphcut"],
        "graphcut",
        "Where images meet: round what differs, midway, or wherever they overlap.",
    ),
    blend,
    crop,
    _choice(
        "--projection",
        ["auto", "plane", "cylinder", "sphere", "mercator", "panini", "stereographic"],
        "auto",
        "How images taken by turning on the spot are laid out.",
    ),
    click.option(
        "--rectangle",
        type=CORNERS,
        help="Four corners, pixels of the reference image as it is read, clockwise: they become an upright "
        "rectangle of its true aspect ratio, the first one its top left corner.",
    ),
    click.option(
        "--straighten",
        type=LINES,
        metavar="off|auto|LINES",
        default="off",
        show_default=True,
        help="Make horizontal and vertical what is so in the scene. auto: edges found in the images; LINES: "
        "'x1,y1,x2,y2;…', ends in pixels of the reference image as it is read.",
    ),
    click.option(
        "--level",
        is_flag=True,
        help="Make vertical on the plane what the cameras measured (XMP, --attitude), else what most images do.",
    ),
    *(
        _number(f"--{name}", RealNumber(), 0.0, f"Turn the view of a panorama {where}, before it is projected.", "DEG")
        for name, where in (("yaw", "to the right"), ("pitch", "up"), ("roll", "clockwise"))
    ),
    interpolation,
    output_form,
    _number(
        "--max-stretch",
        RealNumber(1.0, min_open=True),
        3.0,
        "What an oblique image shows N times coarser than the reference image is not drawn.",
        "N",
    ),
    _number("--rotate", RealNumber(), 0.0, "Turn the output clockwise, degrees; north is then not turned up.", "DEG"),
    click.option(
        "--north-up/--no-north-up",
        default=True,
        help="Turn north up where three images or more have a GPS position that fits.  [default: north up]",
    ),
    click.option(
        "--gsd", type=RealNumber(), metavar="M", help="Metres on the ground that a pixel takes, instead of --scale."
    ),
    click.option(
        "--crs",
        "epsg",
        type=EPSG,
        help="Coordinate system of the map, and of x and y in --positions; otherwise UTM on WGS 84. Others than UTM "
        "need rasterio.",
    ),
)

# What every command that registers images takes, and what those take that also compose them.
layers = together(
    click.option(
        "--layers",
        type=IMAGE,
        metavar="DIR",
        help="Write each image, warped, with alpha, and its mask into DIR: TIFF, cropped, with the offsets that "
        "enblend reads.",
    ),
    click.option("--whole-layers", is_flag=True, help="With --layers: on the whole canvas instead of cropped."),
)

registration = together(overwrite, known, estimation, report, trust)

stitching = together(
    output,
    click.option("--reference", metavar="NAME", help="Image that sets the frame; otherwise the best connected one."),
    click.option(
        "--preview",
        is_flag=True,
        help="A quick small image: at most 1200 pixels, few features of small versions of the images, straight "
        "seams; options that are given stay as they are.",
    ),
    click.option(
        "--local-alignment",
        type=word_or_number(("auto", "off"), 2, 100),
        metavar="auto|off|N",
        default="auto",
        show_default=True,
        help="Where the ground is not quite a plane, bring images together by a smooth displacement of each: auto "
        "where matches that took no part in it come nearer; a number of cells along an image's longer side: always.",
    ),
    compositing,
    _file(
        "--gcp",
        "FILE",
        "Ground control points, as OpenDroneMap's gcp_list.txt; they place the output on the Earth.",
    ),
    layers,
    _file(
        "--hugin-project",
        "FILE",
        "Write a project for Hugin (.pto): all images with lens and pose, and control points.",
    ),
    _file(
        "--save-camera",
        "FILE",
        "Write the estimated camera: .json, .yml (OpenCV), .pto (Hugin), camera_info.yaml (ROS) …",
    ),
    registration,
    as_json("the sidecar"),
    verbosity,
)
