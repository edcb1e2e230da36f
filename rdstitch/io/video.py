"""Frames of a video, as picture files."""

from pathlib import Path
from typing import NamedTuple

import cv2

from rdstitch.errors import InputError, OutputError
from rdstitch.io.decoding import check_readable

VIDEO_SUFFIXES = frozenset((".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg"))


class VideoFrame(NamedTuple):
    """A frame that was written to a file; ``timestamp`` is its time in the video, s."""

    path: Path
    number: int
    timestamp: float


def extract_frames(path: Path, folder: Path, every: int = 1) -> list[VideoFrame]:
    """Write every ``every``-th frame of a video to a folder as PNG, named by video and frame number.

    Raises
    ------
    InputError
        When the video cannot be read, or has no frame.
    OutputError
        When a frame cannot be written.
    """
    check_readable(path)
    capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise InputError(f"{path}: cannot be read as a video; convert it, or extract its frames with another tool")
        written: list[VideoFrame] = []
        number = 0
        while capture.grab():
            if number % every == 0:
                timestamp = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                decoded, frame = capture.retrieve()
                if decoded:
                    file = write_frame(folder / f"{path.stem}_{number:06d}.png", frame)
                    written.append(VideoFrame(file, number, timestamp))
            number += 1
    finally:
        capture.release()
    if not written:
        raise InputError(f"{path}: the video has no frame that can be read")
    return written


def write_frame(file: Path, frame: cv2.typing.MatLike) -> Path:
    """Write a frame in BGR order as PNG, losslessly and quickly.

    Raises
    ------
    OutputError
        When it cannot be written.
    """
    encoded, data = cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not encoded:
        raise OutputError(f"{file}: cannot encode the frame")
    try:
        file.write_bytes(data.tobytes())
    except OSError as error:
        raise OutputError(f"{file}: cannot write the frame: {error.strerror}") from error
    return file
