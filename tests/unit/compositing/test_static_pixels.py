"""What stays at its place in all images: found where it is, and nowhere else."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.compositing.static_pixels import static_pixels
from rdstitch.synthetic import ground

_WIDTH, _HEIGHT, _COUNT = 200, 150, 5


def _images() -> NDArray[np.float32]:
    """Images (5, h, w) of a plane, each of another place."""
    texture = ground((_WIDTH + 400, _HEIGHT), 3)
    places = [texture.region(90 * k, 0, 90 * k + _WIDTH, _HEIGHT)[:, :, 0] for k in range(_COUNT)]
    noise = np.random.default_rng(1).normal(0.0, 0.01, (_COUNT, _HEIGHT, _WIDTH))
    return np.clip(np.stack(places) + noise, 0.05, 1.0).astype(np.float32)


def test_nothing_stays_where_the_camera_moves() -> None:
    assert static_pixels(list(_images())) is None


def test_a_line_along_the_motion_is_not_static() -> None:
    images = _images()
    images[:, 60:64] = 1.0
    images[:, 90:110] *= 0.4
    assert static_pixels(list(images)) is None


@pytest.mark.parametrize("shape", ["body", "border"])
def test_a_body_and_a_black_border_are_found(shape: str) -> None:
    images = _images()
    region = np.zeros((_HEIGHT, _WIDTH), dtype=np.bool_)
    if shape == "body":
        region[100:, 60:] = True
        body = ground((_WIDTH, _HEIGHT), 9).region(0, 0, _WIDTH, _HEIGHT)[:, :, 0]
        images = np.where(region, body, images)
    else:
        v, u = np.ogrid[:_HEIGHT, :_WIDTH]
        region = np.hypot(u - 100, v - 75) > 85
        images[:, region] = 0.0
    found = static_pixels(list((images * 255).astype(np.uint8)))
    assert found[region].mean() > 0.95
    assert found[~region].mean() < 0.06


@pytest.mark.parametrize("band", [0, 255, None], ids=["black", "white", "none"])
def test_of_a_caption_nothing_is_left(band: int | None) -> None:
    """Text at the left and a scale bar at the right, in a band or on the image itself."""
    images = (_images() * 255).astype(np.uint8)
    region, ink = np.zeros((_HEIGHT, _WIDTH), dtype=np.uint8), 0 if band == 255 else 255
    for image in images:
        if band is not None:
            image[128:] = band
        cv2.putText(image, "15 kV 2 kx SE", (6, 145), cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, 1)
        image[136:140, 118:190] = ink
    cv2.putText(region, "15 kV 2 kx SE", (6, 145), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1, 1)
    region[136:140, 118:190] = 1
    if band is not None:
        region[128:] = 1
    found = static_pixels(list(images))
    assert found[region > 0].mean() > 0.95
    assert not found[:115].any()


def test_the_white_margins_of_a_page_with_a_header_that_stays_are_kept() -> None:
    images = (_images() * 255).astype(np.uint8)
    images[:, :, :30] = images[:, :, -30:] = 255
    images[:, :24] = (ground((_WIDTH, 24), 9).region(0, 0, _WIDTH, 24)[:, :, 0] * 255).astype(np.uint8)
    found = static_pixels(list(images))
    assert found[:24].mean() > 0.9
    assert not found[40:].any()


def test_a_camera_that_hardly_moves_masks_nothing() -> None:
    assert static_pixels([_images()[0]] * 5) is None
