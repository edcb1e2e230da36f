"""Options that stand in several classes, or are parameters of several functions."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from rdstitch.choices import ChannelOrder
from rdstitch.options.option import FileUse, Option, Options, Range, option

Every = Annotated[
    int | None,
    Option(
        "Every N-th frame of a video or ROS bag; auto: frames that show new ground.",
        "auto|N",
        within=Range(least=1, most=1_000_000),
        none="auto",
    ),
]
ArrayChannels = Annotated[ChannelOrder, Option("Order of the channels of arrays that come in or go out.", flag=None)]
Topic = Annotated[str | None, Option("Image topic of a ROS bag.", "NAME")]
Mask = Annotated[
    str | Path | None,
    Option(
        "Mask whose black pixels are excluded: a folder of masks with the images' names, or one file for all.",
        "DIR|FILE",
        file=FileUse.READ,
    ),
]
CAMERA_FILE = (
    "Camera file of rdstitch, OpenCV, ROS, Kalibr, COLMAP, OpenDroneMap, Hugin or lensfun; its lens is not estimated."
)
FlatField = Annotated[
    Literal["auto", "off"] | str | Path,
    Option(
        "Flat-field correction: estimated from the images, or read from FILE (second page: the dark field).",
        "auto|off|FILE",
        file=FileUse.READ,
    ),
]
Overwrite = Annotated[bool, Option("Replace existing output files.")]
Height = Annotated[
    float | None,
    Option(
        "Height of the first frame above the plane, whose unit positions have; else they are in heights.",
        "H",
        within=Range(above=0.0),
        needs=("poses", "map_server"),
    ),
]
Distortion = Annotated[
    float | None,
    Option("Known λ (half-diagonal frame); it is not estimated.", "L", "--lambda", within=Range(above=-1.0, below=1.0)),
]


@dataclass(frozen=True)
class RunOptions(Options):
    """What every recipe takes that makes an output."""

    topic: Topic = None
    workers: int = option(
        0,
        "Threads; 0: one for each usable core.",
        "N",
        "-j --workers",
        within=Range(least=0, most=1024),  # more than any machine has cores for
    )
    overwrite: Overwrite = False
    strict: bool = option(False, "Fail with status 5 when an image is left out.")
    dry_run: bool = option(False, "Print size, memory and time of compositing; write nothing.")

    @property
    def of_run(self) -> dict[str, Any]:
        """These options by name, for another recipe."""
        return {each.name: getattr(self, each.name) for each in fields(RunOptions)}
