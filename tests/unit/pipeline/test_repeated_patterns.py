"""Shifts by whole pixels and by a pattern's period, and the order of images."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import rdstitch
from examples.judging import registration_error
from examples.worlds.compositing_scenes import render
from rdstitch.arrays import FloatArray
from rdstitch.features import FeatureOptions
from rdstitch.geometry.camera import Camera
from rdstitch.io.write import write_image
from rdstitch.pipeline.registration import register as stages
from rdstitch.pipeline.registration import repeated_patterns
from rdstitch.synthetic import ImageTexture, Photometry, RenderedSequence, grid_poses, ground, repeated, sequence_over
from rdstitch.verification.unique_places import UniqueShift

_LENS = Camera((400, 300), distortion=-0.25, focal=380.0)
_OPTIONS = rdstitch.StitchOptions(workers=1, features=FeatureOptions(max_features=800))


def _board() -> RenderedSequence:
    pixels = np.kron(np.indices((20, 44)).sum(axis=0) % 2, np.ones((40, 40)))
    poses = grid_poses(_LENS, 4, 1, overlap=0.6, yaw=0.2, shift=0.05, seed=3).shaken(seed=4, tilt=0.12)
    return sequence_over(ImageTexture((60 + 130 * pixels).astype(np.uint8)), _LENS, poses)


def _bend(camera: Camera) -> float:
    """Largest distance between a camera's and the true undistorted points, pixels, at the best common scale."""
    u, v = np.meshgrid(np.linspace(0, 399, 15), np.linspace(0, 299, 11))
    points = np.column_stack([u.ravel(), v.ravel()])
    ours: FloatArray = camera.undistort(points) - _LENS.center
    true: FloatArray = _LENS.undistort(points) - _LENS.center
    scale = float(np.sum(ours * true) / np.sum(ours * ours))
    return float(np.linalg.norm(scale * ours - true, axis=1).max())


def test_boards_are_calibrated_by_crossings(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = _board().frames()
    found = rdstitch.calibrate(frames, _OPTIONS)
    monkeypatch.setattr(stages, "match_crossings", lambda aligner, pairing, aligned, *_: (aligned, {}))
    before = rdstitch.calibrate(frames, _OPTIONS)
    assert found.alignment.used.all()
    assert found.alignment.rms < 0.3 * before.alignment.rms
    assert _bend(found.camera) < min(0.3, _bend(before.camera))


def test_saddles_of_other_ground_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = grid_poses(_LENS, 3, 1, overlap=0.6, seed=3)
    frames = sequence_over(partial(ground, seed=2), _LENS, poses, seed=3).frames()
    plain = rdstitch.calibrate(frames, _OPTIONS)
    monkeypatch.setattr(repeated_patterns, "shows_repeated_pattern", lambda estimator: True)
    found = rdstitch.calibrate(frames, _OPTIONS)
    assert found.camera == plain.camera


LENS = Camera((320, 240), distortion=-0.15, focal=350.0)
OPTIONS = rdstitch.StitchOptions(workers=1, features=rdstitch.FeatureOptions(max_features=500))


def _stained_tiles() -> RenderedSequence:
    poses = grid_poses(LENS, 2, 1, overlap=0.5, yaw=0.1, tilt=(0.03, -0.05), seed=3)
    taken = sequence_over(
        partial(repeated, seed=3, period=60), LENS, poses, photometry=Photometry(noise=0.01), seed=3, margin=60
    )
    width, height = taken.texture.size
    pixels = taken.texture.region(0, 0, width, height).copy()
    rng = np.random.default_rng(8)
    for x, y in zip(rng.integers(8, width - 8, 15), rng.integers(8, height - 8, 15), strict=True):
        pixels[y - 4 : y + 5, x - 4 : x + 5] = rng.choice([0.02, 0.9])
    return RenderedSequence(ImageTexture(pixels), taken.lens, taken.poses, taken.photometry, seed=3)


def test_stained_tiles_are_stitched_where_the_stains_agree() -> None:
    sequence = _stained_tiles()
    result = rdstitch.mosaic([sequence.frame(k) for k in range(len(sequence))], None, OPTIONS)
    alignment = result.registration.alignment
    assert alignment.used.all()
    assert registration_error(alignment, sequence, "homography").median < 0.3
    assert "repeated-pattern" in [message.code for message in result.registration.warnings]


def test_images_that_look_alike_nowhere_else_keep_their_places(monkeypatch: pytest.MonkeyPatch) -> None:
    # As over a car park beside a meadow: keypoints repeat, but an image shows too few periods to find stains in.
    sequence = sequence_over(partial(ground, seed=2), LENS, grid_poses(LENS, 3, 1, overlap=0.6, seed=3), seed=3)
    decided = {(0, 1): UniqueShift(np.zeros(2), 1.0, 1.0, 0.0)}
    monkeypatch.setattr(repeated_patterns, "shows_repeated_pattern", lambda estimator: True)
    monkeypatch.setattr(repeated_patterns, "unique_shifts", lambda placed, pairs, workers: decided)
    result = rdstitch.mosaic([sequence.frame(k) for k in range(3)], None, OPTIONS)
    assert result.registration.alignment.used.all(), result.registration.messages


WHOLE = np.rint(ground((700, 480), 3).region(0, 0, 700, 480) * 255).astype(np.uint8)
SETS = {
    "two": [(0, 0, 420, 480), (280, 0, 700, 480)],
    "four": [(0, 0, 420, 300), (280, 3, 700, 300), (0, 170, 420, 480), (275, 170, 700, 480)],
}
# With a copy and a near copy, of the same image or of another one.
NEAR = (4, 2, 424, 300)
SETS |= {
    "copies first": [SETS["four"][1], NEAR, *SETS["four"]],
    "copies between": [*SETS["four"][:1], NEAR, SETS["four"][0], *SETS["four"][1:]],
    "copies last": [*SETS["four"], NEAR, NEAR],
}


def _crops(name: str, noise: float = 0.0) -> list[NDArray[Any]]:
    rng = np.random.default_rng(1)
    images = [WHOLE[y0:y1, x0:x1].astype(float) for x0, y0, x1, y1 in SETS[name]]
    return [np.clip(np.rint(image + rng.normal(0, noise, image.shape)), 0, 255).astype(np.uint8) for image in images]


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_crops_become_the_image_that_they_are_of(name: str, noise: float) -> None:
    result = rdstitch.mosaic(_crops(name, noise))
    alignment = result.registration.alignment
    assert (alignment.poses, alignment.focal, alignment.tilt, alignment.parameters) == (None, None, None, ())
    assert "whole pixels" in result.registration.summary
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


SCENE = render(4, 1, size=(240, 180), overlap=0.5, distortion=-0.15, seed=3)
ORDERS = [(0, 1, 2, 3), (2, 0, 3, 1)]


@pytest.mark.parametrize("make", [rdstitch.pano, rdstitch.mosaic])
def test_of_files_the_result_is_the_same(make: Callable[..., Any], tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.png" for name in ("a2", "a10", "b", "c")]
    for file, frame in zip(files, SCENE.frames, strict=True):
        write_image(file, frame)
    results = [make([files[k] for k in order]) for order in ORDERS]
    references = {r.registration.sources[r.registration.alignment.reference].name for r in results}
    assert len(references) == 1
    for result in results:
        np.testing.assert_array_equal(result.image, results[0].image)


def test_of_arrays_the_reference_is_the_same() -> None:
    options = rdstitch.StitchOptions(dry_run=True)
    results = [rdstitch.mosaic([SCENE.frames[k] for k in order], options=options) for order in ORDERS]
    references = {order[r.registration.alignment.reference] for order, r in zip(ORDERS, results, strict=True)}
    assert len(references) == 1
    sizes = np.array([result.canvas.size for result in results])
    assert np.ptp(sizes, axis=0).max() <= 2
