"""Images of a ROS bag, of version 1 or 2, as image files with time stamps; no ROS is needed, only ``rosbags``."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rdstitch.errors import InputError, RdstitchError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.keyframes import FrameSelection, wanted_frames
from rdstitch.inputs.odometry import Odometry, odometry_of, yaw_of
from rdstitch.io.video import write_frame
from rdstitch.system.file_access import read_beginning

if TYPE_CHECKING:
    from rdstitch.camera_files import CameraFile

_SUFFIXES = (".bag", ".db3", ".mcap")
_DESCRIPTION, _KEY, _HEADER = "metadata.yaml", b"rosbag2_bagfile_information", 4096
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_ODOMETRY = "nav_msgs/msg/Odometry"
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


def extract_images(
    path: Path, folder: Path, every: int | None = 1, topic: str | None = None
) -> tuple[list[Frame], FrameSelection]:
    """Write images of a topic to a folder, losslessly, with number and time stamp (s) of the header."""
    with opened_bag(path) as reader:
        messages = _Messages.of(reader, path, topic)
        wanted = wanted_frames(every, messages.grey)
        return list(messages.frames(folder, wanted)), wanted


def images_in_bag(path: Path, folder: Path, every: int, topic: str | None = None) -> Iterator[Frame]:
    """The same one after the other, every n-th one."""
    with opened_bag(path) as reader:
        yield from _Messages.of(reader, path, topic).frames(folder, FrameSelection(every))


def camera_in_bag(path: Path, topic: str | None = None) -> "tuple[CameraFile, str] | None":
    """The calibration that the bag has for a topic of images, and its own topic; None where it has none.

    That is the one beside the images, ``/camera/camera_info`` for ``/camera/image_raw``. Of images that are rectified
    already (``image_rect``) it is that of the rectified camera.
    """
    from rdstitch.camera_files import camera_of_content

    with opened_bag(path) as reader:
        images = _chosen_topic(path, _image_topics(reader), topic)
        info_topic = f"{images.removesuffix('/compressed').rpartition('/')[0]}/camera_info"
        chosen = [c for c in reader.connections if c.msgtype == _CAMERA_INFO and c.topic == info_topic]
        for connection, _, data in reader.messages(connections=chosen) if chosen else ():
            message = reader.deserialize(data, connection.msgtype)
            values = {name: getattr(message, name, getattr(message, name.upper(), None)) for name in "dkp"}
            k, d, p = (np.asarray(values[name], dtype=np.float64).ravel() for name in "kdp")
            if not k[0] > 0.0:  # as a driver without a calibration writes it
                return None
            if "rect" in images.rpartition("/")[2] and p[0] > 0.0:
                k, d = p.reshape(3, 4)[:, :3].ravel(), d[:0]
            content: dict[str, Any] = {"width": int(message.width), "height": int(message.height), "k": k.tolist()}
            content["d"] = d.tolist()
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
            yaw = yaw_of(turn.x, turn.y, turn.z, turn.w)
            rows.append((stamp or time_ns * 1e-9, at.x, at.y, yaw, (known[0] + known[7]) / 2.0, known[35]))
    return odometry_of(rows, f"{path}: {topic}")


def camera_in(path: str | Path) -> Camera:
    """The camera of a camera file, or of a bag that has its calibration."""
    from rdstitch.camera_files import load_camera

    if not is_bag(Path(path)):
        return load_camera(path)
    if (found := camera_in_bag(Path(path))) is None:
        raise InputError(f"{path}: the bag has no calibration in a topic of camera_info")
    return found[0].camera


def _image_topics(reader: Any) -> list[str]:
    return sorted({c.topic for c in reader.connections if c.msgtype in (_IMAGE, _COMPRESSED)})


def _chosen_topic(path: Path, topics: list[str], wanted: str | None) -> str:
    listed = ", ".join(topics)
    if not topics:
        raise InputError(f"{path}: the bag has no images")
    if wanted is None and len(topics) > 1:
        raise InputError(f"{path}: the bag has several topics of images; choose one by --topic: {listed}")
    if wanted is not None and wanted not in topics:
        raise InputError(f"{path}: the bag has no images of the topic {wanted}; it has {listed}")
    return wanted or topics[0]


@dataclass(frozen=True)
class _Messages:
    """The images of one topic."""

    reader: Any
    connections: list[Any]
    path: Path

    @classmethod
    def of(cls, reader: Any, path: Path, topic: str | None) -> Self:
        """The images of a topic, or of the only one that has images."""
        chosen = _chosen_topic(path, _image_topics(reader), topic)
        images = [c for c in reader.connections if c.topic == chosen and c.msgtype in (_IMAGE, _COMPRESSED)]
        return cls(reader, images, path)

    def grey(self) -> Iterator[NDArray[np.uint8] | None]:
        """All of them, (H, W), 8 bits; None where one cannot be decoded."""
        for connection, _, data in self.reader.messages(connections=self.connections):
            message = self.reader.deserialize(data, connection.msgtype)
            compressed = connection.msgtype == _COMPRESSED
            pixels = _grey_of_compressed(message.data) if compressed else _pixels(self.path, message)
            if pixels is not None and pixels.ndim == 3:
                pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))
            yield None if pixels is None else _eight_bits(pixels)

    def frames(self, folder: Path, wanted: FrameSelection) -> Iterator[Frame]:
        """Those that are wanted, written to a folder."""
        for number, (connection, time_ns, data) in enumerate(self.reader.messages(connections=self.connections)):
            if number not in wanted:
                continue
            message = self.reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            name = f"{self.path.stem}_{number:06d}"
            if connection.msgtype == _COMPRESSED:
                # By its first bytes: the format field is free text.
                suffix = ".png" if bytes(message.data[:4]) == b"\x89PNG" else ".jpg"
                file = folder / f"{name}{suffix}"
                file.write_bytes(message.data.tobytes())
            else:
                file = write_frame(folder / f"{name}.png", _pixels(self.path, message))
            # Drivers that do not set the stamp leave it 0; the recorder's time is then the best that is known.
            yield Frame(file, number, stamp or time_ns * 1e-9)


def _eight_bits(grey: NDArray[Any]) -> NDArray[np.uint8]:
    """The same picture at any exposure: sensors of 10 or 12 bits leave the highest ones empty."""
    if grey.dtype == np.uint8:
        return grey
    brightest = max(1.0, float(np.quantile(grey[::4, ::4], _WHITE)))
    return np.clip(grey * (255.0 / brightest), 0.0, 255.0).astype(np.uint8)


def _grey_of_compressed(data: NDArray[np.uint8]) -> NDArray[Any] | None:
    """A JPEG or PNG image, (H, W), of 8 or 16 bits; None where it cannot be decoded."""
    try:
        # Not by OpenCV, whose decoders write on standard error.
        with Image.open(BytesIO(data.tobytes()), formats=("JPEG", "PNG")) as image:
            deep = image.mode.startswith("I")
            return np.asarray(image).astype(np.uint16) if deep else np.asarray(image.convert("L"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None


def _pixels(path: Path, message: Any) -> NDArray[Any]:
    """Samples of an uncompressed image, grey or BGR; rows may be padded, and bytes swapped."""
    if message.encoding not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise InputError(f"{path}: images have the encoding {message.encoding}, which is none of {known}")
    kind, channels, to_bgr = _ENCODINGS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.asarray(message.data, dtype=np.uint8)[: message.height * message.step].reshape(message.height, -1)
    needed = message.width * channels
    if message.step < needed * dtype.itemsize:
        raise InputError(
            f"{path}: rows of {message.step} bytes are too short for {message.width} pixels of {message.encoding}"
        )
    samples = np.ascontiguousarray(rows).view(dtype).astype(kind)[:, :needed]
    if channels > 1:
        samples = samples.reshape(message.height, message.width, channels)
    return samples if to_bgr is None else np.asarray(cv2.cvtColor(samples, to_bgr))
