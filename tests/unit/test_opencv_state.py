"""OpenCV's threads and log level are as they were, whatever happened meanwhile."""

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
