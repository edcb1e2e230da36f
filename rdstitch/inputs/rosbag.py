"""ROS bags of version 1 and 2: images, calibration and odometry in them; no ROS is needed, only ``rosbags``."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from PIL import Image

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.errors import InputError, RdstitchError
from rdstitch.inputs.frame import Frame, Named
from rdstitch.inputs.keyframes import FrameSelection, wanted_frames
from rdstitch.inputs.odometry import Odometry, odometry_of, unit_quaternion, yaw_of
from rdstitch.io.video import write_frame
from rdstitch.system.file_access import read_beginning

if TYPE_CHECKING:
    from rdstitch.camera_files import CameraFile

_SUFFIXES = (".bag", ".db3", ".mcap")
_DESCRIPTION, _KEY, _HEADER = "metadata.yaml", b"rosbag2_bagfile_information", 4096
_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_IMAGE_TYPES = ("sensor_msgs/msg/Image", _COMPRESSED)
_ODOMETRY = "nav_msgs/msg/Odometry"
_RECTIFIED = {"rect", "rectified"}  # words, between underscores, of topics of rectified images
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_WHITE = 0.999  # fraction of a frame's pixels of more than 8 bits up to which 8 bits reach
# Of uncompressed images by their encoding: type and number of the samples, and what makes BGR of them.
_ENCODINGS: dict[str, tuple[Any, int, int | None]] = {
    **dict.fromkeys(("mono8", "8UC1"), (np.uint8, 1, None)),
    **dict.fromkeys(("mono16", "16UC1"), (np.uint16, 1, None)),
    **dict.fromkeys(("bgr8", "8UC3"), (np.uint8, 3, None)),
    **dict.fromkeys(("bgr16", "16UC3"), (np.uint16, 3, None)),
    "rgb8": (np.uint8, 3, cv2.COLOR_RGB2BGR),
    "rgb16": (np.uint16, 3, cv2.COLOR_RGB2BGR),
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2BGR),
    "rgba16": (np.uint16, 4, cv2.COLOR_RGBA2BGR),
    **dict.fromkeys(("bgra8", "8UC4"), (np.uint8, 4, cv2.COLOR_BGRA2BGR)),
    "bgra16": (np.uint16, 4, cv2.COLOR_BGRA2BGR),
    # OpenCV names a pattern by its second row.
    "bayer_rggb8": (np.uint8, 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (np.uint8, 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (np.uint8, 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (np.uint8, 1, cv2.COLOR_BayerGB2BGR),
}


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file by its suffix, or a folder that ROS 2 wrote, by what it says of itself."""
    if path.suffix.lower() in _SUFFIXES or not path.is_dir():
        return path.suffix.lower() in _SUFFIXES
    try:
        return _KEY in read_beginning(path / _DESCRIPTION, _HEADER)
    except OSError:
        return False


def only_bag(inputs: Iterable[Named]) -> Path | None:
    """The bag that is the only input, if one is."""
    named = [Path(item) for item in inputs if not isinstance(item, Frame)]
    return named[0] if len(named) == 1 and is_bag(named[0]) else None


@contextmanager
def opened_bag(path: Path) -> "Iterator[Any]":
    """The reader of ``rosbags`` for a bag; what goes wrong inside the block is an error that names it."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(f"{path}: reading ROS bags needs rosbags: pip install rosbags") from None
    # A bag of ROS 2 is a folder; its files may be named as well.
    bag = path.parent if path.suffix.lower() in (".db3", ".mcap") and (path.parent / _DESCRIPTION).is_file() else path
    try:
        with AnyReader([bag], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except (RdstitchError, MemoryError):
        raise
    except Exception as error:  # rosbags raises many kinds on damaged files
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: cannot be read as a ROS bag ({reason[:160]})") from error


def camera_in_bag(path: Path, topic: str | None = None) -> "tuple[CameraFile, str] | None":
    """The calibration that the bag has for a topic of images, and its own topic; None where it has none.

    That is the one beside the images, ``/camera/camera_info`` for ``/camera/image_raw``. Of images that are rectified
    already (``image_rect``) it is that of the rectified camera; of a region of interest it is that of this region.
    """
    from rdstitch.camera_files import camera_of_content

    with opened_bag(path) as reader:
        images = _chosen_topic(path, reader, topic)
        folder, _, name = images.removesuffix("/compressed").rpartition("/")
        info_topic = f"{folder}/camera_info"
        chosen = [c for c in reader.connections if c.msgtype == _CAMERA_INFO and c.topic == info_topic]
        for connection, _, data in reader.messages(connections=chosen) if chosen else ():
            message = reader.deserialize(data, connection.msgtype)
            values = {name: getattr(message, name, getattr(message, name.upper(), None)) for name in "dkp"}
            k, d, p = (np.asarray(values[name], dtype=np.float64).ravel() for name in "kdp")
            if not k[0] > 0.0:  # as a driver without a calibration writes it
                return None
            if not _RECTIFIED.isdisjoint(name.split("_")) and p[0] > 0.0:
                k, d = p.reshape(3, 4)[:, :3].ravel(), d[:0]
            content: dict[str, Any] = {"width": int(message.width), "height": int(message.height)}
            content |= {"k": k.tolist(), "d": d.tolist(), "roi": vars(message.roi)}
            if d.size:
                content["distortion_model"] = message.distortion_model
            return camera_of_content(content, f"{path}: {connection.topic}"), connection.topic
    return None


def odometry_in_bag(path: Path, topic: str) -> Odometry:
    """The odometry of a topic of nav_msgs/Odometry."""
    rows = []
    with opened_bag(path) as reader:
        connections = [c for c in reader.connections if c.topic == topic and c.msgtype == _ODOMETRY]
        if not connections:
            listed = ", ".join(sorted({c.topic for c in reader.connections if c.msgtype == _ODOMETRY})) or "none"
            raise InputError(
                f"{path}: the bag has no odometry of the topic {topic}; topics of nav_msgs/Odometry: {listed}"
            )
        for connection, time_ns, data in reader.messages(connections=connections):
            message = reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            at, turn, known = message.pose.pose.position, message.pose.pose.orientation, message.pose.covariance
            yaw = yaw_of(unit_quaternion((turn.x, turn.y, turn.z, turn.w), f"{path}: {topic}"))
            rows.append((stamp or time_ns * 1e-9, at.x, at.y, yaw, (known[0] + known[7]) / 2.0, known[35]))
    return odometry_of(rows, f"{path}: {topic}")


def _chosen_topic(path: Path, reader: Any, wanted: str | None) -> str:
    """The topic of images that is wanted, or the only one that there is."""
    topics = sorted({c.topic for c in reader.connections if c.msgtype in _IMAGE_TYPES})
    listed = ", ".join(topics)
    if not topics:
        raise InputError(f"{path}: the bag has no images")
    if wanted is None and len(topics) > 1:
        raise InputError(f"{path}: the bag has several topics of images; choose one by --topic: {listed}")
    if wanted is not None and wanted not in topics:
        raise InputError(f"{path}: the bag has no images of the topic {wanted}; it has {listed}")
    return wanted or topics[0]


def extract_images(
    path: Path, folder: Path, every: int | None = 1, topic: str | None = None
) -> tuple[list[Frame], FrameSelection]:
    """Write images of a topic to a folder, losslessly, with number and time stamp (s) of the header."""
    with opened_bag(path) as reader:
        wanted = wanted_frames(every, partial(_grey, path, reader, topic))
        return list(_frames(path, reader, topic, folder, wanted)), wanted


def images_in_bag(path: Path, folder: Path, every: int, topic: str | None = None) -> Iterator[Frame]:
    """Write every n-th image of a topic to a folder, one after the other, as :func:`extract_images` does."""
    with opened_bag(path) as reader:
        yield from _frames(path, reader, topic, folder, FrameSelection(every))


def _messages(path: Path, reader: Any, topic: str | None) -> Iterator[tuple[Any, int, bytes]]:
    """Connection, time (ns) and content of the images of a topic, or of the only one that has images."""
    chosen = _chosen_topic(path, reader, topic)
    images = [c for c in reader.connections if c.topic == chosen and c.msgtype in _IMAGE_TYPES]
    yield from reader.messages(connections=images)


def _grey(path: Path, reader: Any, topic: str | None) -> Iterator[UInt8Array | None]:
    """All images, (H, W), 8 bits; None where one cannot be decoded."""
    for connection, _, data in _messages(path, reader, topic):
        message = reader.deserialize(data, connection.msgtype)
        compressed = connection.msgtype == _COMPRESSED
        pixels = _grey_of_compressed(message.data) if compressed else _pixels(path, message)
        if pixels is not None and pixels.ndim == 3:
            pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))
        yield None if pixels is None else _eight_bits(pixels)


def _frames(path: Path, reader: Any, topic: str | None, folder: Path, wanted: FrameSelection) -> Iterator[Frame]:
    for number, (connection, time_ns, data) in enumerate(_messages(path, reader, topic)):
        if number not in wanted:
            continue
        message = reader.deserialize(data, connection.msgtype)
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        name = f"{path.stem}_{number:06d}"
        if connection.msgtype == _COMPRESSED:
            # By its first bytes: the format field is free text.
            suffix = ".png" if bytes(message.data[:4]) == b"\x89PNG" else ".jpg"
            file = folder / f"{name}{suffix}"
            file.write_bytes(message.data.tobytes())
        else:
            file = write_frame(folder / f"{name}.png", _pixels(path, message))
        # Drivers that do not set the stamp leave it 0; the recorder's time is then the best that is known.
        yield Frame(file, number, stamp or time_ns * 1e-9)


def _eight_bits(grey: AnyArray) -> UInt8Array:
    """Grey of 8 bits, the same at any exposure: sensors of 10 or 12 bits leave the highest ones empty."""
    if grey.dtype == np.uint8:
        return grey
    brightest = max(1.0, float(np.quantile(grey[::4, ::4], _WHITE)))
    return np.clip(grey * (255.0 / brightest), 0.0, 255.0).astype(np.uint8)


def _grey_of_compressed(data: UInt8Array) -> AnyArray | None:
    """A JPEG or PNG image, (H, W), of 8 or 16 bits; None where it cannot be decoded."""
    try:
        # Not by OpenCV, whose decoders write on standard error.
        with Image.open(BytesIO(data.tobytes()), formats=("JPEG", "PNG")) as image:
            deep = image.mode.startswith("I")
            return np.asarray(image).astype(np.uint16) if deep else np.asarray(image.convert("L"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None


def _pixels(path: Path, message: Any) -> AnyArray:
    """Samples of an uncompressed image, grey or BGR; rows may be padded, and bytes swapped."""
    if message.encoding not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise InputError(f"{path}: images have the encoding {message.encoding}, which is none of {known}")
    kind, channels, to_bgr = _ENCODINGS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, step, data = message.height, message.step, np.asarray(message.data, dtype=np.uint8)
    if len(data) < height * step:
        raise InputError(f"{path}: {len(data)} bytes are too few for {height} rows of {step}")
    needed = message.width * channels
    if step < needed * dtype.itemsize:
        raise InputError(f"{path}: rows of {step} bytes are too short for {message.width} pixels of {message.encoding}")
    rows = data[: height * step].reshape(height, step)
    samples = np.ascontiguousarray(rows).view(dtype).astype(kind)[:, :needed]
    if channels > 1:
        samples = samples.reshape(message.height, message.width, channels)
    return samples if to_bgr is None else np.asarray(cv2.cvtColor(samples, to_bgr))
