"""ROS bags of version 1 and 2, and the calibration and odometry in them; no ROS is needed, only ``rosbags``.

Their images are read by :mod:`rdstitch.inputs.rosbag_images`.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rdstitch.errors import InputError, RdstitchError
from rdstitch.inputs.frame import Frame, Named
from rdstitch.inputs.odometry import Odometry, odometry_of, unit_quaternion, yaw_of
from rdstitch.system.file_access import read_beginning

if TYPE_CHECKING:
    from rdstitch.camera_files import CameraFile

_SUFFIXES = (".bag", ".db3", ".mcap")
_DESCRIPTION, _KEY, _HEADER = "metadata.yaml", b"rosbag2_bagfile_information", 4096
COMPRESSED = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = ("sensor_msgs/msg/Image", COMPRESSED)
_ODOMETRY = "nav_msgs/msg/Odometry"
_RECTIFIED = {"rect", "rectified"}  # words, between underscores, of topics of rectified images
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


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
        images = chosen_topic(path, reader, topic)
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
            shown = message
            if (region := message.roi).width and region.height:  # zeros stand for the whole image
                shown = region
                k = k - (0.0, 0.0, region.x_offset, 0.0, 0.0, region.y_offset, 0.0, 0.0, 0.0)
            content: dict[str, Any] = {"width": int(shown.width), "height": int(shown.height), "k": k.tolist()}
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
            yaw = yaw_of(unit_quaternion((turn.x, turn.y, turn.z, turn.w), f"{path}: {topic}"))
            rows.append((stamp or time_ns * 1e-9, at.x, at.y, yaw, (known[0] + known[7]) / 2.0, known[35]))
    return odometry_of(rows, f"{path}: {topic}")


def chosen_topic(path: Path, reader: Any, wanted: str | None) -> str:
    """The topic of images that is wanted, or the only one that there is."""
    topics = sorted({c.topic for c in reader.connections if c.msgtype in IMAGE_TYPES})
    listed = ", ".join(topics)
    if not topics:
        raise InputError(f"{path}: the bag has no images")
    if wanted is None and len(topics) > 1:
        raise InputError(f"{path}: the bag has several topics of images; choose one by --topic: {listed}")
    if wanted is not None and wanted not in topics:
        raise InputError(f"{path}: the bag has no images of the topic {wanted}; it has {listed}")
    return wanted or topics[0]
