"""Strips over ground as rough as a tenth of the camera's height keep their shape, by one camera."""

import pytest

from rdstitch.alignment import AlignmentOptions, align
from tests.relief_strips import displacement, strip


@pytest.mark.parametrize("seed", [4, 5])
def test_a_strip_over_ridges_keeps_its_shape(seed: int) -> None:
    """By the flank that each pair shows best it is off by 2.8 and 5.1 per cent of its length."""
    item = strip("slopes", 0.1, seed, 16)
    found = align(item.cameras, item.links, AlignmentOptions())
    assert found.used.all()
    assert found.model != "homography"
    assert displacement(item, found) < 0.02
    assert abs(found.distortion - item.distortion) < 3.0 * found.distortion_std
    assert found.relief.found


def test_hills_do_not_move_the_distortion_centre() -> None:
    """With the centre free and a focal length of 4255 pixels it is off by 2.9 per cent of its length."""
    item = strip("bumps", 0.1, 5, 40)
    found = align(item.cameras, item.links, AlignmentOptions())
    assert found.lens == "division"
    assert displacement(item, found) < 0.02


def test_a_strip_does_not_go_downhill() -> None:
    """With all pairs from the earlier picture to the later one, heights fall by a quarter: off by 3.1 per cent."""
    item = strip("slopes", 0.1, 3, 40)
    found = align(item.cameras, item.links, AlignmentOptions())
    assert found.used.all()
    assert displacement(item, found) < 0.02
