"""Frames as they arrive: in a folder that grows, by names, from a video, a bag, a camera or a stream."""

import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import cv2

from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.frame import Frame, Named, array_as_image
from rdstitch.inputs.growing_folder import GrowingFolder
from rdstitch.inputs.rosbag import images_in_bag, is_bag
from rdstitch.io.video import VIDEO_SUFFIXES, grabbed_frames, opened_capture, write_frame

_POLL_SECONDS = 0.2
_REOPEN_SECONDS = 5.0  # without a frame, after which a camera or stream is opened again
_MAX_PENDING = 256  # names that are read ahead


@dataclass(frozen=True)
class FrameStream:
    """Iterates over the frames of one source, each once it is complete."""

    frames: Iterator[Frame]
    inputs: list[Named]  # what an ordinary run over all that has arrived takes; grows with them where they are names
    # whether a frame whose file is not whole will come again
    comes_again: Callable[[Frame], bool] = lambda frame: False

    def __iter__(self) -> Iterator[Frame]:
        return self.frames


def open_frame_stream(
    source: str | Path,
    *,
    frames_folder: Callable[[], Path],
    names: IO[str] | None = None,
    every: int = 1,
    idle: float | None = None,
    topic: str | None = None,
) -> FrameStream:
    """The frames of a folder, a video, a bag, a camera by its index, a stream, or of ``names``, one a line, for "-".

    Every n-th frame is taken of videos, bags, cameras and streams; of folders and lists of names all are. They end with
    a video or bag, with the list of names, and after ``idle`` seconds without a new one; those of a folder or camera go
    on until they are interrupted otherwise. Streams are whatever else OpenCV opens
    ("rtsp://…", "/dev/video0"); what comes only once is kept in ``frames_folder``.
    """
    path, name, kept = Path(source), str(source), list[Named]()
    if name == "-":
        if names is None:
            raise ArgumentError("there is no list of names to follow")
        return FrameStream(_of_names(names, idle, kept), kept)
    if is_bag(path):
        return FrameStream(images_in_bag(path, frames_folder(), every, topic), [name])
    if path.is_dir():
        folder = GrowingFolder(path, idle)
        return FrameStream(folder.frames(), [name], folder.comes_again)
    if path.suffix.lower() in VIDEO_SUFFIXES and path.exists():
        return FrameStream(_of_video(path, every), [name])
    if name.isdecimal() or "://" in name or path.is_char_device():
        return FrameStream(_of_stream(name, every, idle, frames_folder, kept), kept)
    raise InputError(
        f"{name}: cannot be followed; name a folder, a video, the index of a camera or a stream, or - "
        "for names on standard input"
    )


def _of_names(names: IO[str], idle: float | None, kept: list[Named]) -> Iterator[Frame]:
    """Images whose names are read, by a thread that may wait for them."""
    read: queue.Queue[str | None] = queue.Queue(_MAX_PENDING)
    threading.Thread(target=_read_lines, args=(names, read), daemon=True).start()
    while True:
        try:
            # Not endlessly: an interrupt is noticed between two waits only on Windows.
            name = read.get(timeout=_POLL_SECONDS if idle is None else idle)
        except queue.Empty:
            if idle is None:
                continue
            return
        if name is None:
            return
        if name:
            frame = Frame(Path(name))
            kept.append(frame)
            yield frame


def _read_lines(stream: IO[str], read: "queue.Queue[str | None]") -> None:
    try:
        # As bytes where there are any: names of files need not be UTF-8.
        for line in getattr(stream, "buffer", stream):
            read.put(os.fsdecode(line).rstrip("\r\n"))
    except (OSError, ValueError):  # closed while it was read
        pass
    read.put(None)


def _of_video(video: Path, every: int) -> Iterator[Frame]:
    """Every n-th frame of a video with its number and time."""
    for number, stamp, capture in grabbed_frames(video):
        decoded, pixels = capture.retrieve() if number % every == 0 else (False, None)
        if decoded and pixels is not None:
            name = f"{video.stem}_{number:06d}.png"
            yield Frame(Path(name), number, stamp, array_as_image(name, pixels, "bgr"))


def _of_stream(
    stream: str, every: int, idle: float | None, folder: Callable[[], Path], kept: list[Named]
) -> Iterator[Frame]:
    """Every n-th frame of a camera or stream; kept as files too, since they come only once."""
    source = int(stream) if stream.isdecimal() else stream
    with opened_capture(source) as capture:
        if not capture.isOpened():
            raise InputError(f"{source}: OpenCV cannot open this camera, video or stream")
        number, last = 0, time.monotonic()
        opened, has_end = last, capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0  # a video behind a URL
        while True:
            if not capture.grab():
                now = time.monotonic()
                if has_end if idle is None else now - last >= idle:
                    return
                time.sleep(_POLL_SECONDS)
                if not has_end and now - max(last, opened) >= _REOPEN_SECONDS:
                    capture.open(source)
                    opened = time.monotonic()
                continue
            last, stamp = time.monotonic(), time.time()
            decoded, pixels = capture.retrieve() if number % every == 0 else (False, None)
            if decoded and pixels is not None:
                name = f"frame_{number:06d}.png"
                kept.append(Frame(write_frame(folder() / name, pixels), number, stamp))
                yield Frame(Path(name), number, stamp, array_as_image(name, pixels, "bgr"))
            number += 1
