"""Images as the tiles need them."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.camera import Camera
from rdstitch.compositing.source_images import ImageReader
from rdstitch.errors import InputError
from tests.compositing_scenes import as_image, place_images


def test_an_image_unlike_the_first_is_named_also_in_blocks() -> None:
    frames: list[NDArray[Any]] = [
        np.zeros((60, 80, 3), np.uint8),
        np.zeros((60, 80), np.uint8),
        np.zeros((60, 80, 3), np.uint16),
    ]
    read = [partial(as_image, frame) for frame in frames]
    images = place_images(read, [Camera((80, 60))] * 3, [np.eye(3)] * 3, paths=["in/a.png", "in/b.png", "in/c.png"])
    reader = ImageReader(images)
    assert reader(0).pixels.shape == reader(1).pixels.shape == (60, 80, 3)
    for whole, index in ((reader, 2), (reader.part([1, 2]), 1)):
        with pytest.raises(InputError, match=r"^in/c\.png: has uint16 samples, but a\.png has uint8 samples; convert"):
            whole(index)
