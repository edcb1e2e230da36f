"""Frames of a video, as picture files."""

from pathlib import Path

import cv2

from rdstitch.errors import InputError, OutputError

VIDEO_SUFFIXES = frozenset((".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg"))


def extract_frames(path: Path, folder: Path, every: int = 1) -> list[Path]:
    """Write every ``every``-th frame of a video to a folder as PNG, named by video and frame number.

    Raises
    ------
    InputError
        When the video cannot be read, or has no frame.
    OutputError
        When a frame cannot be written.
    """
    capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise InputError(f"{path}: cannot be read as a video; convert it, or extract its frames with another tool")
        written: list[Path] = []
        number = 0
        while capture.grab():
            if number % every == 0:
                decoded, frame = capture.retrieve()
                if decoded:
                    written.append(_write(folder / f"{path.stem}_{number:06d}.png", frame))
            number += 1
    finally:
        capture.release()
    if not written:
        raise InputError(f"{path}: the video has no frame that can be read")
    return written


def _write(file: Path, frame: cv2.typing.MatLike) -> Path:
    encoded, data = cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not encoded:
        raise OutputError(f"{file}: cannot encode the frame")
    try:
        file.write_bytes(data.tobytes())
    except OSError as error:
        raise OutputError(f"{file}: cannot write the frame: {error.strerror}") from error
    return file
