"""OpenCV's threads and log level are as they were, whatever happened meanwhile."""

import os
import subprocess
import sys
from contextlib import suppress
from typing import Any

import cv2
import pytest

from rdstitch.system.opencv_state import one_opencv_thread, silent_opencv

LOGGING: Any = getattr(cv2.utils, "logging", cv2)
THREADS = (one_opencv_thread, cv2.getNumThreads, cv2.setNumThreads, 1)
LEVEL = (silent_opencv, LOGGING.getLogLevel, LOGGING.setLogLevel, 0)


@pytest.mark.parametrize("state", [THREADS, LEVEL], ids=["threads", "log level"])
def test_the_last_to_leave_gives_back_what_was(state: tuple[Any, ...]) -> None:
    changed, current, put, inside = state
    before = current()
    first, second = changed(), changed()
    try:
        put(3)
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert current() == inside
        second.__exit__(None, None, None)
        assert current() == 3
        with suppress(ZeroDivisionError), changed():
            current(1 // 0)
        assert current() == 3
    finally:
        put(before)


_IN_A_FORKED_CHILD = """
import os, sys
import cv2
import numpy as np
from rdstitch.features.detect import detect
from rdstitch.system.opencv_state import one_opencv_thread

image = np.random.default_rng(0).integers(0, 255, (400, 600), dtype=np.uint8)
cv2.setNumThreads(4)
cv2.GaussianBlur(np.tile(image, (5, 5)).astype(np.float32), (0, 0), 3.0)
cv2.setNumThreads(int(sys.argv[1]))
before = cv2.getNumThreads()
if (child := os.fork()) == 0:
    with one_opencv_thread():
        inside = cv2.getNumThreads()
        found = len(detect(image).points)
    os._exit(0 if (inside, cv2.getNumThreads()) == (1, before) and found else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
@pytest.mark.parametrize("threads", ["4", "0"])
def test_a_forked_process_does_not_wait_for_the_threads_of_its_parent(threads: str) -> None:
    # It would wait for ever; the limit is for the test to end.
    done = subprocess.run([sys.executable, "-c", _IN_A_FORKED_CHILD, threads], timeout=120, check=False)
    assert done.returncode == 0
