"""The judges are judged: known errors are put in, and must come out."""

from functools import partial

import cv2
import numpy as np
import pytest

from examples.judging import alignment_error, compare_with_plane, coverage, fit_homography, fit_similarity, sharpness
from examples.judging.alignment import Transfer
from examples.judging.fitting import apply, quantile
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError
from rdstitch.synthetic import ImageTexture, blank, grid_poses, ground, sequence_over
from rdstitch.synthetic.poses import texels_of_pixels
from rdstitch.synthetic.textures import LinearPixels

SIMILARITY = np.array([[0.9, -0.3, 140.0], [0.3, 0.9, -50.0], [0.0, 0.0, 1.0]])
HOMOGRAPHY = np.array([[0.95, -0.2, 110.0], [0.25, 1.0, -90.0], [5e-5, -8e-5, 1.0]])


def mosaic_of(plane: ImageTexture, transform: FloatArray, size: tuple[int, int]) -> np.ndarray:
    """A mosaic (8-bit RGBA) that shows the plane through a transform from its px to texels."""
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    image = cv2.warpPerspective(plane.pixels, transform, size, flags=flags)
    filled = cv2.warpPerspective(np.full(plane.pixels.shape[:2], 255, np.uint8), transform, size, flags=flags) > 250
    colours = np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8) * filled[:, :, None]
    return np.dstack([colours, filled.astype(np.uint8) * 255])


@pytest.fixture(scope="module")
def plane() -> ImageTexture:
    texture = ground((640, 500), 11)
    assert isinstance(texture, ImageTexture)
    return texture


def test_fits_recover_what_was_applied() -> None:
    points = np.random.default_rng(0).uniform(-300, 900, (30, 2))
    np.testing.assert_allclose(fit_similarity(points, apply(SIMILARITY, points)), SIMILARITY, atol=1e-10)
    np.testing.assert_allclose(fit_homography(points, apply(HOMOGRAPHY, points)), HOMOGRAPHY, atol=1e-8)


def test_fits_minimise_the_squared_distances() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 900, (40, 2))
    target = apply(HOMOGRAPHY, points) + rng.normal(0, 5, points.shape)
    for fit, free in ((fit_similarity, 2), (fit_homography, 3)):
        best = fit(points, target)
        least = np.sum((apply(best, points) - target) ** 2)
        for _ in range(100):
            change = 1e-6 * rng.standard_normal((3, 3))
            if free == 2:
                (a, b), (tx, ty) = rng.normal(0, 1e-4, 2), rng.normal(0, 1e-2, 2)
                change = np.array([[a, -b, tx], [b, a, ty], [0, 0, 0]])
            assert np.sum((apply(best + change, points) - target) ** 2) > least


def test_fits_refuse_what_determines_nothing() -> None:
    with pytest.raises(ArgumentError):
        fit_similarity(np.ones((5, 2)), np.ones((5, 2)))
    line = np.column_stack([np.arange(6.0), 2.0 * np.arange(6.0)])
    with pytest.raises(ArgumentError):
        fit_homography(line, line)
    with pytest.raises(ArgumentError):
        fit_homography(line[:3], line[:3])


def test_a_quantile_counts_what_is_lost() -> None:
    errors = np.array([1.0, 2.0, 3.0, np.inf])
    assert quantile(errors, 0.5) == 2.0
    assert quantile(errors, 0.75) == 3.0
    assert quantile(errors, 0.95) == np.inf


def test_alignment_error_of_truth_and_of_a_shifted_image() -> None:
    lens = Camera((320, 240), -0.3, focal=260.0)
    sequence = sequence_over(blank, lens, grid_poses(lens, 2, 2, yaw=0.2, tilt=(0.05, -0.04)))
    back = np.linalg.inv(SIMILARITY)

    def true_place(index: int, points: FloatArray) -> FloatArray:
        return apply(back, sequence.to_plane(index, points))

    truth: dict[int, Transfer] = {k: partial(true_place, k) for k in range(4)}
    exact = alignment_error(sequence, truth)
    np.testing.assert_allclose(exact.transform, SIMILARITY, atol=1e-7)
    assert exact.max < 1e-6

    # One of four images 4 mosaic px off: a quarter of that goes into the fit.
    wrong: dict[int, Transfer] = {**truth, 2: lambda p: truth[2](p) + np.array([4.0, 0.0])}
    moved = alignment_error(sequence, wrong)
    assert moved.error_mosaic[moved.image == 2].mean() == pytest.approx(3.0, abs=0.5)
    assert moved.error_mosaic[moved.image != 2].mean() == pytest.approx(1.0, abs=0.5)
    assert max(moved.per_image(), key=moved.per_image().__getitem__) == 2

    # A wrong λ is no similarity: it must show, in px of the images.
    bent = Camera((320, 240), -0.32, focal=260.0)
    estimate: dict[int, Transfer] = {k: partial(texels_of_pixels, bent, sequence.from_plane(k)) for k in range(4)}
    error = alignment_error(sequence, estimate)
    assert 0.3 < error.median < error.percentile95 < error.max < 5.0

    lost = alignment_error(sequence, {0: truth[0], 1: lambda p: np.full_like(p, np.nan)})
    assert lost.percentile95 == np.inf
    assert lost.median < 1e-6


@pytest.mark.parametrize(("model", "transform"), [("similarity", SIMILARITY), ("homography", HOMOGRAPHY)])
def test_a_perfect_mosaic_has_no_error(plane: ImageTexture, model: str, transform: FloatArray) -> None:
    mosaic = mosaic_of(plane, transform, (560, 500))
    result = compare_with_plane(mosaic, plane, model=model)
    assert result.median < 0.01
    assert result.percentile95 < 0.03
    assert result.found == 1.0
    assert result.correlation > 0.999
    corners = np.array([(50.0, 50), (510, 50), (510, 450), (50, 450)])
    np.testing.assert_allclose(apply(result.transform, corners), apply(transform, corners), atol=0.05)


def test_perspective_is_an_error_for_a_similarity(plane: ImageTexture) -> None:
    result = compare_with_plane(mosaic_of(plane, HOMOGRAPHY, (560, 500)), plane)
    assert result.median > 3.0


def test_a_displaced_part_is_found_displaced(plane: ImageTexture) -> None:
    """The right third is shown (3, -2) px from its place; what the fit takes is the same for all patches."""
    mosaic = mosaic_of(plane, SIMILARITY, (560, 500))
    shifted = np.roll(mosaic, (-2, 3), axis=(0, 1))
    mosaic[:, 373:] = shifted[:, 373:]
    result = compare_with_plane(mosaic, plane, start=SIMILARITY)
    right, left = result.center[:, 0] > 400, result.center[:, 0] < 350
    back = np.linalg.inv(SIMILARITY)
    shown = apply(back, apply(result.transform, result.center - result.residual))
    raw = result.center - shown
    np.testing.assert_allclose(np.nanmedian(raw[right], axis=0), (3.0, -2.0), atol=0.05)
    np.testing.assert_allclose(np.nanmedian(raw[left], axis=0), (0.0, 0.0), atol=0.05)
    assert result.percentile95 > 1.0


def test_exposure_and_noise_hardly_matter(plane: ImageTexture) -> None:
    mosaic = mosaic_of(plane, SIMILARITY, (560, 500)).astype(np.float64)
    bright = 0.7 * mosaic[:, :, :3] + 30.0 + np.random.default_rng(2).normal(0.0, 4.0, mosaic[:, :, :3].shape)
    image = np.dstack([np.clip(bright, 0, 255), mosaic[:, :, 3]]).astype(np.uint8)
    result = compare_with_plane(image, plane)
    assert result.median < 0.05
    assert result.found > 0.99


def test_a_part_that_shows_something_else_is_lost(plane: ImageTexture) -> None:
    mosaic = mosaic_of(plane, SIMILARITY, (560, 500))
    mosaic[150:300, 200:400, :3] = mosaic[150:300, 200:400, :3][::-1, ::-1]
    result = compare_with_plane(mosaic, plane)
    assert result.median < 0.05
    assert result.percentile95 == np.inf


def test_another_plane_is_nothing_of_this_one(plane: ImageTexture) -> None:
    other = ground((560, 500), 12)
    mosaic = np.rint(255 * other.region(0, 0, 560, 500)).astype(np.uint8)
    result = compare_with_plane(mosaic, plane, reachable=np.ones((500, 640), dtype=np.bool_))
    assert result.median == np.inf
    assert result.found == 0.0
    assert result.coverage == 0.0


def test_coverage_counts_the_missing(plane: ImageTexture) -> None:
    reachable = np.zeros((500, 640), dtype=np.bool_)
    reachable[100:400, 150:550] = True
    filled = np.ones((500, 640), dtype=np.bool_)
    assert coverage(filled, np.eye(3), reachable) == 1.0
    filled[:, 450:] = False
    assert coverage(filled, np.eye(3), reachable) == pytest.approx(298 / 396, abs=1e-3)
    mosaic = (255 * plane.pixels).astype(np.uint8) * filled[:, :, None]
    assert compare_with_plane(mosaic, plane, reachable=reachable).coverage == pytest.approx(298 / 396, abs=5e-3)


def test_sharpness_falls_with_blur_and_ignores_gain(plane: ImageTexture) -> None:
    grey: LinearPixels = np.ascontiguousarray(plane.pixels[:, :, 1])
    everywhere = np.ones(grey.shape, dtype=np.bool_)
    blurred = np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.8), dtype=np.float32)
    assert sharpness(grey * np.float32(0.6) + np.float32(0.1), grey, everywhere) == pytest.approx(1.0, abs=1e-4)
    assert sharpness(blurred, grey, everywhere) < 0.8
