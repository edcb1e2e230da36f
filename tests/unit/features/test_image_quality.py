"""Sharpness and exposure, measured where an image is opaque."""

import cv2
import numpy as np
import pytest

from rdstitch.features.image_quality import ImageQuality

DETAIL = np.random.default_rng(0).integers(40, 200, (120, 160)).astype(np.uint8)


def test_blur_lowers_sharpness_and_nothing_has_none() -> None:
    sharp, blurred = (ImageQuality.of(image, None) for image in (DETAIL, cv2.GaussianBlur(DETAIL, (0, 0), 2.0)))
    assert blurred.sharpness < 0.6 * sharp.sharpness
    assert ImageQuality.of(np.full_like(DETAIL, 90), None).sharpness == 0.0
    assert ImageQuality.of(DETAIL, np.zeros_like(DETAIL)).brightness == 0.0


def test_what_is_transparent_is_not_burnt_out() -> None:
    burnt, alpha = DETAIL.copy(), np.full_like(DETAIL, 255)
    burnt[:60], alpha[:60] = 255, 0
    assert ImageQuality.of(burnt, None).burnt_out == pytest.approx(0.5)
    assert ImageQuality.of(burnt, alpha).burnt_out == 0.0


def test_twelve_bits_in_sixteen_are_as_bright_as_the_sensor_says() -> None:
    full, dark = (ImageQuality.of(DETAIL.astype(np.uint16) * factor, None) for factor in (16, 1))
    assert (full.full_scale, dark.full_scale) == (4095.0, 255.0)
    brightest = max(full.full_scale, dark.full_scale)
    assert full.at_full_scale(brightest) == full
    assert dark.at_full_scale(brightest).brightness == pytest.approx(full.brightness / 16.0, rel=0.01)
