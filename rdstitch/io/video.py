"""Frames of a video, as image files."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import cv2
import numpy as np

from rdstitch.arrays import UInt8Array
from rdstitch.errors import InputError, OutputError
from rdstitch.io.opening import check_readable
from rdstitch.system.native_threads import silent_opencv

_FFMPEG_LEVEL, _FFMPEG_QUIET = "OPENCV_FFMPEG_LOGLEVEL", "-8"
_ffmpeg_unloaded = Lock()  # until the first video of the process

_CUT_OFF = 0.95  # of what the header says; in some containers that is an estimate
VIDEO_SUFFIXES = frozenset((".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg"))


class VideoFrame(NamedTuple):
    """A frame that was written to a file; ``timestamp`` is its time in the video, s."""

    path: Path
    number: int
    timestamp: float


def grey_frames(path: Path) -> Iterator[UInt8Array | None]:
    """All frames of a video, (H, W); None where one cannot be decoded."""
    for _, _, capture in grabbed_frames(path):
        decoded, frame = capture.retrieve()
        yield np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), dtype=np.uint8) if decoded else None


def extract_frames(path: Path, folder: Path, wanted: Callable[[int], bool]) -> tuple[list[VideoFrame], str]:
    """Write frames of a video, those whose numbers are wanted, to a folder as PNG, named by video and frame number.

    And why frames may be missing; empty where the video goes on as long as its header says.
    """
    written: list[VideoFrame] = []
    damage, lost = "", 0
    for number, timestamp, capture in grabbed_frames(path):
        count, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        cut_off = number + 1 < _CUT_OFF * count and timestamp * rate < _CUT_OFF * count
        damage = f"ends after {number + 1} of {count:.0f} frames; copy it again from its source" if cut_off else ""
        is_wanted = wanted(number)
        decoded, frame = capture.retrieve() if is_wanted else (False, None)
        lost += is_wanted and not decoded
        if decoded and frame is not None:
            file = write_frame(folder / f"{path.stem}_{number:06d}.png", frame)
            written.append(VideoFrame(file, number, timestamp))
    if not written:
        raise InputError(f"{path}: the video has no frame that can be read")
    frames = "1 frame cannot be decoded and is" if lost == 1 else f"{lost} frames cannot be decoded and are"
    return written, "; ".join(filter(None, (damage, f"{frames} left out" if lost else "")))


def grabbed_frames(path: Path) -> Iterator[tuple[int, float, cv2.VideoCapture]]:
    """Number and time, s, of each frame of a video, and what decodes it."""
    check_readable(path)
    with opened_capture(str(path)) as capture:
        if not capture.isOpened():
            raise InputError(f"{path}: cannot be read as a video; convert it, or extract its frames with another tool")
        number = 0
        while capture.grab():
            yield number, capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0, capture
            number += 1


@contextmanager
def opened_capture(source: str | int) -> Iterator[cv2.VideoCapture]:
    """A video, stream or camera, whether it can be opened or not, while neither OpenCV nor FFmpeg logs anything."""
    with silent_opencv():
        # What OpenCV gives to FFmpeg as its level when it loads it, once: later the environment is left alone.
        unset = _ffmpeg_unloaded.acquire(blocking=False) and _FFMPEG_LEVEL not in os.environ
        if unset:
            os.environ[_FFMPEG_LEVEL] = _FFMPEG_QUIET
        try:
            capture = cv2.VideoCapture(source)
        finally:
            if unset:
                os.environ.pop(_FFMPEG_LEVEL, None)
        try:
            yield capture
        finally:
            capture.release()


def write_frame(file: Path, frame: cv2.typing.MatLike) -> Path:
    """Write a frame in BGR order as PNG, losslessly and quickly."""
    encoded, data = cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not encoded:
        raise OutputError(f"{file}: cannot encode the frame")
    try:
        file.write_bytes(data.tobytes())
    except OSError as error:
        raise OutputError(f"{file}: cannot write the frame: {error.strerror}") from error
    return file
