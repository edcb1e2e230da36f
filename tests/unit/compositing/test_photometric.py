"""The correction of samples is the formula, in every type of sample."""

from typing import Any

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing import gain_compensation
from rdstitch.compositing.canvas import plan_canvas
from rdstitch.compositing.overlap_cells import compare_overlaps
from rdstitch.compositing.photometric import Exposure, full_scale, no_exposure
from rdstitch.compositing.source_images import ImageReader
from rdstitch.compositing.survey import survey_images
from rdstitch.compositing.warp import locate, plan_warp
from rdstitch.synthetic.rendering import Photometry
from tests.compositing_scenes import place_images, render

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


@pytest.mark.parametrize("fields", [np.zeros((0, 0, 0, 0)), np.full((2, 3, 3, 3), -0.1)], ids=["gain", "fields"])
def test_nothing_but_full_scale_becomes_full_scale(fields: FloatArray) -> None:
    """Brightened samples are compressed from the knee on, in order, and darkened ones are as without it."""
    ramp = np.broadcast_to(np.arange(80, dtype=np.uint16)[:, None, None] * 831 - 114, (80, 100, 3)).astype(np.uint16)
    ramp = np.sort(np.clip(ramp, 0, 65535), axis=0)
    ramp[-1] = 65535
    gains = np.array([[0.0] * 3, [-0.3, -0.1, 0.4]])
    compressed, clipped = (Exposure(OFFSET, gains, fields=fields, knee=k).correct(1, GEOMETRY, ramp) for k in (0.7, 1))
    assert (np.diff(compressed.astype(int), axis=0) > 0).all()
    assert (compressed[-1, :, :2] == 65535).all()
    assert (compressed[:-1, :, :2] < 65535).all()
    assert (clipped[:-1, :, 0] == 65535).any()
    below = clipped < 0.69 * 65535
    assert np.abs(compressed[below].astype(int) - clipped[below]).max() <= 1
    np.testing.assert_array_equal(compressed[..., 2], clipped[..., 2])


def test_an_image_without_overlap_has_the_gain_that_its_camera_wrote_down() -> None:
    scene = render(3, 1, size=(160, 120), photometry=Photometry(gain=np.array([1.0, 1.0, 2.0]), gamma=2.4), seed=2)
    apart = scene.homographies.copy()
    apart[2] = np.array([[1.0, 0.0, 2000.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ apart[2]
    canvas = plan_canvas(scene.cameras, apart)
    sets = [place_images(scene.sources, scene.cameras, apart, exposure=e) for e in (None, [0.5, 0.5, 1.0])]
    survey = survey_images(ImageReader(sets[0]), sets[0], canvas)
    cells = compare_overlaps(survey)
    differences = gain_compensation._Differences.of(cells, 0.055)
    gains = [gain_compensation._fit(differences, images)[0].log_gain for images in sets]
    assert np.abs(gains[0][2]).max() < 0.01
    np.testing.assert_allclose(gains[1][2] - gains[1][:2].mean(axis=0), np.log(2.0) / 2.4, atol=0.02)
