"""OpenCV's threads and log level are as they were, whatever happened meanwhile."""

import os
import subprocess
import sys
from typing import Any

import cv2
import pytest

from rdstitch.opencv_state import one_opencv_thread, silent_opencv


def test_the_last_to_leave_gives_the_threads_back() -> None:
    before = cv2.getNumThreads()
    first, second = one_opencv_thread(), one_opencv_thread()
    try:
        cv2.setNumThreads(3)
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert cv2.getNumThreads() == 1
        second.__exit__(None, None, None)
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


def _fail_inside() -> None:
    with one_opencv_thread():
        assert cv2.getNumThreads() == 1
        raise ZeroDivisionError


def test_there_is_one_thread_inside_and_as_many_as_before_afterwards() -> None:
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(3)
        with pytest.raises(ZeroDivisionError):
            _fail_inside()
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


def test_the_log_level_survives_threads() -> None:
    logging: Any = getattr(cv2.utils, "logging", cv2)
    before = logging.getLogLevel()
    first, second = silent_opencv(), silent_opencv()
    try:
        logging.setLogLevel(4)
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert logging.getLogLevel() == 0
        second.__exit__(None, None, None)
        assert logging.getLogLevel() == 4
    finally:
        logging.setLogLevel(before)


_IN_A_FORKED_CHILD = """
import os, sys
import cv2
import numpy as np
from rdstitch.features.detect import detect
from rdstitch.opencv_state import one_opencv_thread

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
