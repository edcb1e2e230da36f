"""Frames as they arrive: in a folder that grows, by names on standard input, from a video, a camera or a stream."""

import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import cv2

from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.find import images_in, is_rdstitch_output, natural_key
from rdstitch.inputs.frame import Frame, Named, array_as_image
from rdstitch.inputs.rosbag import images_in_bag, is_bag
from rdstitch.io.video import VIDEO_SUFFIXES, opened_capture, write_frame
from rdstitch.system.file_access import file_state

_POLL_SECONDS = 0.2  # seconds between two looks at a folder
_COMPLETE_AFTER_SECONDS = 1.0  # seconds after its last change from which on a file is read at the first look
_GIVE_UP_SECONDS = 3.0  # seconds after its last change from which on a file that is not whole is reported
_MAX_PENDING = 256  # names that are read ahead


class Arrivals:
    """Iterates over the frames of one source as they arrive.

    The iteration ends with a video or ROS bag, with the end of a list of names, and after ``idle`` seconds without a
    new frame; that of a folder or camera goes on until it is interrupted otherwise. The source is a folder, a video, a
    bag, the index of a camera, what else OpenCV opens as a stream ("rtsp://…", "/dev/video0"), or "-" for names, one a
    line.
    """

    def __init__(
        self,
        source: str | Path,
        *,
        frames_folder: Callable[[], Path],
        names: IO[str] | None = None,
        every: int = 1,
        idle: float | None = None,
        topic: str | None = None,
    ) -> None:
        self._source, self._names, self._every, self._idle = str(source), names, every, idle
        self._frames_folder, self._topic = frames_folder, topic
        self._seen: list[Frame] = []
        self._done: set[Path] = set()
        self._not_whole: dict[Path, tuple[int, int]] = {}  # files, and the state that they were read at
        path = Path(self._source)
        if self._source == "-":
            if names is None:
                raise ArgumentError("there is no list of names to follow")
            self._kind = "names"
        elif is_bag(path):
            self._kind = "bag"
        elif path.is_dir():
            self._kind = "folder"
        elif path.suffix.lower() in VIDEO_SUFFIXES and path.exists():
            self._kind = "video"
        elif self._source.isdecimal() or "://" in self._source or path.is_char_device():
            self._kind = "stream"
        else:
            raise InputError(
                f"{self._source}: cannot be followed; name a folder, a video, the index of a camera or a stream, or - "
                "for names on standard input"
            )

    @property
    def inputs(self) -> list[Named]:
        """What an ordinary run over all that has arrived takes."""
        if self._kind in ("folder", "video", "bag"):
            return [self._source]
        return list(self._seen)

    def comes_again(self, frame: Frame) -> bool:
        """Whether a frame whose file is not whole will come again, since its file may still be written.

        A file that has not changed for so long that it should be reported comes again only if it changes after all.
        """
        if self._kind != "folder" or (state := file_state(frame.path)) is None:
            return False
        self._not_whole[frame.path] = state
        if time.time() - state[1] / 1e9 > _GIVE_UP_SECONDS:
            return False
        self._done.discard(frame.path)
        return True

    def __iter__(self) -> Iterator[Frame]:
        """Every frame, once it is complete."""
        if self._kind == "folder":
            return self._of_folder(Path(self._source))
        if self._kind == "bag":
            return images_in_bag(Path(self._source), self._frames_folder(), self._every, self._topic)
        return self._of_names() if self._kind == "names" else self._of_capture()

    def _of_folder(self, folder: Path) -> Iterator[Frame]:
        """New images of a folder, in natural order as far as they come at the same time."""
        states: dict[Path, tuple[int, int]] = {}
        last = time.monotonic()
        while True:
            complete, waiting = [], False
            for path in images_in(folder):
                read_at = self._not_whole.get(path)
                if path in self._done and read_at is None:
                    continue
                state = file_state(path)
                if state is None or (path in self._done and state == read_at):
                    continue
                age, still = time.time() - state[1] / 1e9, states.get(path) == state
                waiting |= read_at is not None
                states[path] = state
                if read_at is not None:
                    ready = (still and state != read_at) or age > _GIVE_UP_SECONDS
                else:
                    ready = still or age > _COMPLETE_AFTER_SECONDS
                if state[0] and ready:
                    complete.append(path)
            for path in sorted(complete, key=natural_key):
                self._done.add(path)
                self._not_whole.pop(path, None)
                states.pop(path)
                if not is_rdstitch_output(path):
                    yield Frame(path)
                    last = time.monotonic()
            if not complete:
                if not waiting and self._is_over(last):
                    return
                time.sleep(_POLL_SECONDS)

    def _of_names(self) -> Iterator[Frame]:
        """The images whose names are read, by a thread that may wait for them."""
        assert self._names is not None
        read: queue.Queue[str | None] = queue.Queue(_MAX_PENDING)
        threading.Thread(target=_read_lines, args=(self._names, read), daemon=True).start()
        while True:
            try:
                # Not endlessly: an interrupt is noticed between two waits only on Windows.
                name = read.get(timeout=_POLL_SECONDS if self._idle is None else self._idle)
            except queue.Empty:
                if self._idle is None:
                    continue
                return
            if name is None:
                return
            if name:
                frame = Frame(Path(name))
                self._seen.append(frame)
                yield frame

    def _of_capture(self) -> Iterator[Frame]:
        """Every n-th frame of a video, camera or stream; those of a camera and a stream are kept as files too."""
        live = self._kind == "stream"
        stem = "frame" if live else Path(self._source).stem
        with opened_capture(int(self._source) if self._source.isdecimal() else self._source) as capture:
            if not capture.isOpened():
                raise InputError(f"{self._source}: OpenCV cannot open this camera, video or stream")
            number, last = 0, time.monotonic()
            while True:
                if not capture.grab():
                    if not live or self._idle is None or self._is_over(last):
                        return
                    time.sleep(_POLL_SECONDS)
                    continue
                last = time.monotonic()
                stamp = time.time() if live else capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                decoded, pixels = capture.retrieve() if number % self._every == 0 else (False, None)
                if decoded and pixels is not None:
                    name = f"{stem}_{number:06d}.png"
                    if live:
                        self._seen.append(Frame(write_frame(self._frames_folder() / name, pixels), number, stamp))
                    yield Frame(Path(name), number, stamp, array_as_image(name, pixels, "bgr"))
                number += 1

    def _is_over(self, last: float) -> bool:
        return self._idle is not None and time.monotonic() - last >= self._idle


def _read_lines(stream: IO[str], read: "queue.Queue[str | None]") -> None:
    """Hand on the lines of a stream, and None at its end."""
    try:
        # As bytes where there are any: names of files need not be UTF-8.
        for line in getattr(stream, "buffer", stream):
            read.put(os.fsdecode(line).rstrip("\r\n"))
    except (OSError, ValueError):  # closed while it was read
        pass
    read.put(None)
