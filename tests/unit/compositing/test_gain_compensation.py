"""The correction of samples is the formula, in every type of sample."""

from typing import Any

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.compositing.canvas import plan_canvas
from rdstitch.compositing.gain_compensation import Exposure, full_scale, no_exposure
from rdstitch.compositing.warp import locate, plan_warp

OFFSET, LOG_GAIN, VIGNETTING = 0.04, np.array([[0.0, 0.0, 0.0], [0.2, -0.1, 0.05]]), np.array([-0.3, 0.1, -0.05])
LENS = Camera((1600, 1200), distortion=-0.2)
WARP = plan_warp(LENS, np.eye(3), plan_canvas([LENS], np.eye(3)[None]), 0)
GEOMETRY = locate(WARP, (300, 200, 400, 280))


@pytest.mark.parametrize("vignetting", [np.zeros(3), VIGNETTING], ids=["gain", "vignetting"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_samples_are_as_if_all_were_exposed_alike(dtype: Any, vignetting: Any) -> None:
    full = full_scale(np.dtype(dtype))
    samples = (np.random.default_rng(0).uniform(0.1, 1.0, (*GEOMETRY.shape, 3)) * full).astype(dtype)
    done = Exposure(OFFSET, LOG_GAIN, vignetting).correct(1, GEOMETRY, samples)
    assert done.dtype == dtype
    r2 = (LENS.normalize(np.stack(GEOMETRY.maps, axis=-1)) ** 2).sum(axis=-1)[..., None]
    gain = np.exp(-LOG_GAIN[1] - r2 * (vignetting[0] + r2 * (vignetting[1] + r2 * vignetting[2])))
    expected = gain * (samples / full + OFFSET) - OFFSET
    if np.dtype(dtype).kind == "u":
        expected = np.clip(expected, 0.0, 1.0)
    # Rounded, and vignetting between the nodes of a lattice by a straight line.
    np.testing.assert_allclose(done / full, expected, atol=0.5 / full + (2e-4 if vignetting.any() else 1e-6))


def test_nothing_to_correct_leaves_the_very_samples() -> None:
    samples = np.zeros((*GEOMETRY.shape, 3), dtype=np.uint8)
    assert no_exposure(2, 3).correct(1, GEOMETRY, samples) is samples
