"""Options of undistorting single images."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rdstitch.choices import Framing, ImageFormat
from rdstitch.options.option import Options, documented, option, reads
from rdstitch.options.shared_options import CAMERA_FILE, ArrayChannels, Distortion, Overwrite, Topic

if TYPE_CHECKING:
    from rdstitch.geometry.camera import Camera


@documented
@dataclass(frozen=True)
class UndistortOptions(Options):
    """Options of :func:`rdstitch.undistort`; the command line has the same names and defaults.

    The lens is a camera, which is adapted to the size of each image, or λ. What is shown says ``view``: "same": size
    and scale at the centre stay; "all": everything that the image shows, at that scale; "valid": the largest rectangle
    about the middle of the image, of its aspect ratio, that it covers, at that scale.
    """

    camera: "Camera | str | Path | None" = reads(CAMERA_FILE)
    distortion: Distortion = None
    view: Framing = option(
        "same", "Field of view: size and scale of the image, everything it shows, or without empty borders."
    )
    image_format: ImageFormat | None = option(
        None,
        "Format of the files written; otherwise that of each image, or png where it cannot be written.",
        flag="--format",
    )
    overwrite: Overwrite = False
    topic: Topic = None
    channel_order: ArrayChannels = "bgr"
