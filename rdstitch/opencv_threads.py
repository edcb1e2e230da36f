"""OpenCV's own threads, and ours."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

import cv2

# OpenCV has one number for the whole process: the first to come in takes it, and the last to leave gives it back.
_lock, _inside = Lock(), list[int]()


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Keep OpenCV from starting threads of its own while we run several: they would wait for each other."""
    with _lock:
        _inside.append(cv2.getNumThreads())
        cv2.setNumThreads(1)
    try:
        yield
    finally:
        with _lock:
            before = _inside[0]
            _inside.pop()
            if not _inside:
                cv2.setNumThreads(before)
