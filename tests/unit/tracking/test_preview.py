"""The image of what has been seen so far."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.camera import Camera
from rdstitch.tracking import Placement, Preview

_CAMERA = Camera((160, 120))


def _at(x: float, y: float) -> Placement:
    """An image straight from above, one unit of the plane for half its diagonal."""
    return Placement(_CAMERA, np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]]), 1.0)


def _image(level: int) -> NDArray[np.uint8]:
    image = np.full((120, 160, 3), level, dtype=np.uint8)
    image[:60] //= 2  # darker above
    return image


def test_frames_lie_beside_one_another_the_right_way_up() -> None:
    preview = Preview()
    preview.paint(_image(200), _at(0.0, 0.0))
    preview.paint(_image(100), _at(1.6, 0.0))
    height, width = preview.pixels.shape[:2]
    assert width / height == pytest.approx(160 * 2 / 120, rel=0.02)
    assert preview.pixels.any(axis=2).mean() > 0.97
    above, below = preview.pixels[height // 4], preview.pixels[3 * height // 4]
    assert above[width // 4].tolist() == [100] * 3
    assert below[width // 4].tolist() == [200] * 3
    assert below[3 * width // 4].tolist() == [100] * 3


def test_it_grows_in_all_directions_and_stays_within_its_bound() -> None:
    preview = Preview(side=300)
    rng = np.random.default_rng(0)
    for place in rng.uniform(-6.0, 6.0, (40, 2)):
        preview.paint(_image(200), _at(*place))
    preview.paint(_image(240), _at(0.0, 0.0))
    assert max(preview.pixels.shape[:2]) <= 300
    assert max(preview.pixels.shape[:2]) > 150
    assert preview.pixels.any(axis=2).mean() > 0.3


def test_what_is_beyond_the_horizon_or_far_too_large_is_left_out() -> None:
    preview = Preview(side=300)
    preview.paint(_image(200), _at(0.0, 0.0))
    before = preview.pixels.copy()
    horizon = Placement(_CAMERA, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 1.0]]), 1.0)
    preview.paint(_image(50), horizon)
    preview.paint(_image(50), Placement(_CAMERA, np.diag([100.0, 100.0, 1.0]), 1.0))
    assert np.array_equal(preview.pixels, before)


@pytest.mark.parametrize(("dtype", "full"), [("uint8", 255), ("uint16", 65535), ("float32", 1.0)])
def test_grey_and_deep_frames_are_painted_in_eight_bits(dtype: str, full: float) -> None:
    preview = Preview()
    preview.paint(np.full((120, 160), full, dtype=dtype), _at(0.0, 0.0))
    assert preview.pixels[preview.pixels.any(axis=2)].min() == 255
