"""The camera and the odometry that the user gives, in files or in a ROS bag."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from rdstitch.errors import InputError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.exif_orientation import inverse, turned_size
from rdstitch.inputs.find import find_images
from rdstitch.inputs.frame import Named
from rdstitch.inputs.odometry import Odometry
from rdstitch.inputs.rosbag import camera_in_bag, is_bag, odometry_in_bag, only_bag
from rdstitch.io.metadata import read_metadata
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.results.messages import Message


def read_camera(camera: Camera | str | Path, inputs: Sequence[Named] = ()) -> tuple[Camera, list[Message]]:
    """Read a camera from its file or a bag; with a message on the fit if λ is fitted to another lens model.

    Its size, where a file has none, is that of the first of ``inputs``.
    """
    if isinstance(camera, Camera):
        return camera, []
    file = camera
    if is_bag(Path(file)):
        if (calibrated := camera_in_bag(Path(file))) is None:
            raise InputError(f"{file}: the bag has no calibration in a topic of camera_info")
        return calibrated[0].camera, []
    from rdstitch.camera_files import read_camera_file  # with all formats, which most runs have no use for

    read = read_camera_file(file, partial(_stored_size, file, inputs))
    if read.fit is None:
        return read.camera, []
    left = f"rms {read.fit.rms:.2f} pixels, at most {read.fit.largest:.2f} pixels"
    left += ", by which images are corrected" if read.camera.lens_model is not None else ""
    text = f"λ = {read.camera.nearest_distortion:.6f} was fitted to the {read.kind} lens model, {left}"
    return read.camera, [Message(f"{file}: {text}", severity="note")]


def _stored_size(file: str | Path, inputs: Sequence[Named]) -> tuple[int, int]:
    """Width and height of the first input image as it is stored."""
    try:
        first = find_images(inputs).frames[0]
        if first.image is not None:
            return first.image.metadata.size
        metadata = read_metadata(first.path)
    except (InputError, IndexError) as error:
        raise InputError(f"{file}: has no image size; add image_width and image_height") from error
    return turned_size(metadata.size, inverse(metadata.orientation))


def with_camera(
    options: StitchOptions, inputs: Sequence[Named] = (), *, of_bag: bool
) -> tuple[StitchOptions, list[Message]]:
    """The options with their camera file read or, ``of_bag``, the calibration of the input bag; with messages."""
    if options.camera is not None:
        camera, messages = read_camera(options.camera, inputs)
        return replace(options, camera=camera), messages
    bag = only_bag(inputs) if of_bag and options.known_distortion is None else None
    if bag is None or (calibration := camera_in_bag(bag, options.topic)) is None:
        return options, []
    file, topic = calibration
    text = f"the calibration in the bag, {topic}, is used; --camera FILE takes another one"
    note = Message(text, (str(bag),), "note")
    return replace(options, camera=file.camera, lens="auto", solver="auto"), [note]


def with_odometry_of_bag(inputs: Iterable[Named], options: StitchOptions) -> StitchOptions:
    """The options, with odometry read from the input bag if they name one of its topics."""
    topic = options.odometry
    if topic is None or isinstance(topic, Odometry) or Path(topic).is_file() or not str(topic).startswith("/"):
        return options
    if (bag := only_bag(inputs)) is None:
        raise InputError(f"{topic}: no such file; a topic of odometry needs one ROS bag as input")
    return replace(options, odometry=odometry_in_bag(bag, str(topic)))
