"""OpenCV's threads are as they were, whatever happened meanwhile."""

import cv2
import pytest

from rdstitch.opencv_threads import one_opencv_thread


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
