"""Pictures as the tiles need them."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from rdstitch.camera import Camera
from rdstitch.compositing.placed_picture import place_pictures
from rdstitch.compositing.source_images import PictureReader, prepare_picture
from rdstitch.errors import InputError
from tests.compositing_scenes import as_picture


def test_what_is_transparent_has_the_samples_of_the_nearest_opaque_pixel() -> None:
    rng = np.random.default_rng(0)
    height, width = 60, 80
    opaque = np.ones((height, width), dtype=np.bool_)
    opaque[:, 55:] = False
    opaque[10:25, 10:30] = rng.random((15, 20)) > 0.7
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([x, y, np.zeros_like(x)], axis=-1).astype(np.uint8)
    filled = prepare_picture(as_picture(pixels, np.where(opaque, np.uint8(255), np.uint8(0))), 1.0).pixels
    assert np.array_equal(filled[opaque], pixels[opaque])
    hidden, source = np.argwhere(~opaque), filled[~opaque][:, 1::-1].astype(np.intp)
    assert opaque[tuple(source.T)].all()
    nearest = KDTree(np.argwhere(opaque)).query(hidden)[0]
    assert (np.linalg.norm(source - hidden, axis=1) <= 1.05 * nearest).all()  # distances of 5 x 5 chamfers


def test_a_picture_unlike_the_first_is_named_also_in_blocks() -> None:
    frames: list[NDArray[Any]] = [
        np.zeros((60, 80, 3), np.uint8),
        np.zeros((60, 80), np.uint8),
        np.zeros((60, 80, 3), np.uint16),
    ]
    read = [partial(as_picture, frame) for frame in frames]
    pictures = place_pictures(read, [Camera((80, 60))] * 3, [np.eye(3)] * 3, paths=["in/a.png", "in/b.png", "in/c.png"])
    reader = PictureReader(pictures)
    assert reader(0).pixels.shape == reader(1).pixels.shape == (60, 80, 3)
    for whole, index in ((reader, 2), (reader.part([1, 2]), 1)):
        with pytest.raises(InputError, match=r"^in/c\.png: has uint16 samples, but a\.png has uint8 samples; convert"):
            whole(index)
