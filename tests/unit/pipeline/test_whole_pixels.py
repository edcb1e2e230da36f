"""Crops of one image come together as that image, sample for sample; what lies between pixels stays there."""

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import rdstitch
from rdstitch.synthetic import ground

WHOLE = np.rint(ground((700, 480), 3).region(0, 0, 700, 480) * 255).astype(np.uint8)
SETS = {
    "two": [(0, 0, 420, 480), (280, 0, 700, 480)],
    "four": [(0, 0, 420, 300), (280, 3, 700, 300), (0, 170, 420, 480), (275, 170, 700, 480)],
}


def _crops(name: str, noise: float = 0.0) -> list[NDArray[Any]]:
    rng = np.random.default_rng(1)
    images = [WHOLE[y0:y1, x0:x1].astype(float) for x0, y0, x1, y1 in SETS[name]]
    return [np.clip(np.rint(image + rng.normal(0, noise, image.shape)), 0, 255).astype(np.uint8) for image in images]


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_crops_become_the_image_that_they_are_of(name: str, noise: float) -> None:
    result = rdstitch.mosaic(_crops(name, noise))
    pixels, alpha = result.composite.pixels[..., ::-1], result.composite.alpha
    assert pixels.shape == WHOLE.shape
    covered = np.zeros(alpha.shape, dtype=np.bool_)
    for x0, y0, x1, y1 in SETS[name]:
        covered[y0:y1, x0:x1] = True
    np.testing.assert_array_equal(alpha > 0, covered)
    difference = np.abs(pixels.astype(int) - WHOLE)[covered]
    if noise:
        # Not resampled: noise is as it was, but where images are blended.
        assert difference.std() > 0.9 * np.abs(np.random.default_rng(0).normal(0, noise, 10**5)).std()
    else:
        # But where one that ends is blended into others.
        assert (difference > 0).mean() < 1e-3


@pytest.mark.parametrize("shift", [0.25, 0.5])
def test_half_pixels_are_not_rounded(shift: float) -> None:
    first, second = _crops("two", 1.0)
    moved = cv2.warpAffine(second, np.array([[1.0, 0.0, -shift], [0.0, 1.0, 0.0]]), (420, 480), flags=cv2.INTER_CUBIC)
    alignment = rdstitch.mosaic([first, moved[:, :-2]]).registration.alignment
    found = alignment.transfer(1, 0, np.array([[200.0, 240.0]]))[0]
    assert found[0] == pytest.approx(480.0 + shift, abs=0.08)
