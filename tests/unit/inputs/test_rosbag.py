"""Images of ROS bags that are compressed: decoded, or black, and nobody writes on standard error."""

import cv2
import numpy as np
import pytest

from rdstitch.inputs.rosbag import _grey_of_compressed

_NOISE = np.random.default_rng(0).integers(0, 65536, (60, 80), dtype=np.uint16)
SMOOTH = np.asarray(cv2.GaussianBlur(_NOISE, (0, 0), 3), dtype=np.uint16)


def test_compressed_images_are_decoded() -> None:
    grey = (SMOOTH >> 8).astype(np.uint8)
    for suffix, samples, off in ((".png", grey, 0), (".png", SMOOTH, 0), (".jpg", grey, 4)):
        found = _grey_of_compressed(cv2.imencode(suffix, samples)[1])
        assert np.abs(found.astype(int) - grey).max() <= off


def test_damaged_images_are_black_or_what_is_left_without_a_word(capfd: pytest.CaptureFixture[str]) -> None:
    for suffix in (".jpg", ".png"):
        data = cv2.imencode(suffix, (SMOOTH >> 8).astype(np.uint8))[1].copy()
        _grey_of_compressed(data[: len(data) // 2])
        data[len(data) // 2 : len(data) // 2 + 9] = 7
        _grey_of_compressed(data)
    assert (_grey_of_compressed(np.frombuffer(b"no image", np.uint8)) == 0).all()
    assert capfd.readouterr().err == ""
