"""Images of a ROS bag, as image files with time stamps."""

from collections.abc import Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.errors import InputError
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.keyframes import FrameSelection, wanted_frames
from rdstitch.inputs.rosbag import COMPRESSED, IMAGE_TYPES, chosen_topic, opened_bag
from rdstitch.io.video import write_frame

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
    chosen = chosen_topic(path, reader, topic)
    images = [c for c in reader.connections if c.topic == chosen and c.msgtype in IMAGE_TYPES]
    yield from reader.messages(connections=images)


def _grey(path: Path, reader: Any, topic: str | None) -> Iterator[UInt8Array | None]:
    """All images, (H, W), 8 bits; None where one cannot be decoded."""
    for connection, _, data in _messages(path, reader, topic):
        message = reader.deserialize(data, connection.msgtype)
        compressed = connection.msgtype == COMPRESSED
        pixels = _grey_of_compressed(message.data) if compressed else _pixels(path, message)
        if pixels is not None and pixels.ndim == 3:
            pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))
        yield None if pixels is None else _eight_bits(pixels)


def _frames(path: Path, reader: Any, topic: str | None, folder: Path, wanted: FrameSelection) -> Iterator[Frame]:
    """The wanted images, written to a folder."""
    for number, (connection, time_ns, data) in enumerate(_messages(path, reader, topic)):
        if number not in wanted:
            continue
        message = reader.deserialize(data, connection.msgtype)
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        name = f"{path.stem}_{number:06d}"
        if connection.msgtype == COMPRESSED:
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
