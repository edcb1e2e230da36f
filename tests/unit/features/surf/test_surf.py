"""SURF finds blobs where and as large as they are, and describes them the same however the image is turned."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.features import FeatureOptions, detect, match
from rdstitch.features.surf.descriptor import describe_patches, orientations
from rdstitch.features.surf.hessian import find_blobs
from rdstitch.features.surf.patches import pyramid, to_level
from rdstitch.features.surf.refinement import refine
from rdstitch.synthetic import ground

Grey = NDArray[np.uint8]


def texture(width: int = 480, height: int = 400, seed: int = 5) -> Grey:
    """Ground, smoothed as a lens does."""
    image = ground((width, height), seed, 1).region(0, 0, width, height).reshape(height, width)
    return np.asarray(cv2.convertScaleAbs(cv2.GaussianBlur(image, (0, 0), 1.0), alpha=255.0), np.uint8)


def blob(center: tuple[float, float], sigma: float, sign: int = 1, size: int = 160) -> Grey:
    v, u = np.mgrid[:size, :size]
    squared = (u - center[0]) ** 2 + (v - center[1]) ** 2
    return np.asarray(np.rint(128 + sign * 90 * np.exp(-squared / (2 * sigma**2))), np.uint8)


def turned(grey: Grey, degrees: float) -> tuple[Grey, NDArray[np.float64]]:
    """The image turned about its centre, and the motion (2, 3)."""
    height, width = grey.shape
    motion = np.asarray(cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1.0), np.float64)
    return np.asarray(cv2.warpAffine(grey, motion, (width, height), flags=cv2.INTER_CUBIC), np.uint8), motion


def box_hessian(grey: Grey, size: int, u: int, v: int) -> float:
    """Determinant of the Hessian by the filters as the paper draws them."""
    lobe, values = size // 3, grey.astype(np.float64)

    def mean(left: int, top: int, right: int, bottom: int) -> float:
        return float(values[v + top : v + bottom + 1, u + left : u + right + 1].sum())

    half, side = size // 2, lobe - 1
    mid = lobe // 2
    duu = mean(-half, -side, half, side) - 3 * mean(-mid, -side, mid, side)
    dvv = mean(-side, -half, side, half) - 3 * mean(-side, -mid, side, mid)
    duv = mean(1, 1, lobe, lobe) + mean(-lobe, -lobe, -1, -1) - mean(1, -lobe, lobe, -1) - mean(-lobe, 1, -1, lobe)
    return duu * dvv / (lobe * (2 * lobe - 1)) ** 2 - (0.9 * duv / lobe**2) ** 2


def test_the_response_is_the_determinant_of_the_papers_box_filters() -> None:
    grey = texture()
    blobs = find_blobs(grey, 50.0, octaves=1, layers=3)
    assert len(blobs) > 200
    for index in range(0, len(blobs), 10):
        u, v = np.rint(blobs.points[index]).astype(int)
        # Refined places are within one sample of the maximum.
        around = [
            box_hessian(grey, size, u + du, v + dv) for size in (15, 21, 27) for du in (-1, 0, 1) for dv in (-1, 0, 1)
        ]
        assert min(abs(np.array(around) - blobs.response[index])) < 1e-3 * blobs.response[index]


def test_strips_leave_no_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    grey = texture()
    reference = find_blobs(grey, 50.0, 3, 3)
    monkeypatch.setattr("rdstitch.features.surf.hessian._STRIP_ROWS", 7)
    strips = find_blobs(grey, 50.0, 3, 3)
    assert len(reference) == len(strips) > 200
    a, b = (found.take(np.lexsort((*found.points.T, found.size))) for found in (reference, strips))
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.response, b.response)


@pytest.mark.parametrize("sigma", [3.0, 4.4, 7.0, 13.0])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_blob_is_found_where_it_is_and_as_large(sigma: float, sign: int) -> None:
    center = (80.3, 78.6)
    grey = blob(center, sigma, sign)
    boxes = find_blobs(grey, 100.0, 4, 3)
    strongest = boxes.take(np.array([int(boxes.response.argmax())]))
    np.testing.assert_allclose(strongest.points[0], center, atol=0.04 * sigma)
    assert strongest.laplacian_sign[0] == -sign
    refined = refine(pyramid(grey, 7), strongest)
    np.testing.assert_allclose(refined.points[0], center, atol=0.01 * sigma)
    # s is the σ of the Gaussian that a box filter stands for, 1.43 times too small for its maximum over scale.
    assert refined.scale[0] * 1.43 == pytest.approx(sigma, rel=0.06)


@pytest.mark.parametrize("degrees", [10.0, 37.0, 90.0, 160.0])
def test_orientation_turns_with_the_image(degrees: float) -> None:
    grey = texture()
    other, motion = turned(grey, degrees)
    rng = np.random.default_rng(0)
    points = rng.uniform((150, 110), (330, 290), (200, 2))
    scale = rng.uniform(1.6, 4.0, 200)
    before = orientations(pyramid(grey, 7), points, scale)
    after = orientations(pyramid(other, 7), points @ motion[:, :2].T + motion[:, 2], scale)
    # getRotationMatrix2D counts anticlockwise, v points down.
    difference = np.angle(np.exp(1j * (after - before + np.radians(degrees))))
    assert np.median(np.abs(difference)) < np.radians(3)
    assert np.mean(np.abs(difference) < np.radians(10)) > 0.9


def test_descriptors_follow_rotation_scale_and_contrast() -> None:
    grey = texture()
    rng = np.random.default_rng(1)
    points, scale, angle = rng.uniform((150, 110), (330, 290), (60, 2)), rng.uniform(1.6, 4, 60), rng.uniform(0, 6, 60)
    reference = describe_patches(pyramid(grey, 7), points, scale, angle)
    assert reference.shape == (60, 64)
    np.testing.assert_allclose(np.linalg.norm(reference, axis=1), 1.0, rtol=1e-5)
    between_different = np.linalg.norm(reference - np.roll(reference, 1, axis=0), axis=1)

    other, motion = turned(grey, 25.0)
    moved = points @ motion[:, :2].T + motion[:, 2]
    rotated = describe_patches(pyramid(other, 7), moved, scale, angle - np.radians(25.0))
    doubled = np.asarray(cv2.resize(grey, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC), np.uint8)
    scaled = describe_patches(pyramid(doubled, 8), to_level(points, -1), scale * 2, angle)
    dimmed = describe_patches(pyramid(np.rint(grey * 0.5 + 40).astype(np.uint8), 7), points, scale, angle)
    for descriptors in (rotated, scaled, dimmed):
        difference = np.linalg.norm(descriptors - reference, axis=1)
        assert np.median(difference) < 0.15 * np.median(between_different)


@pytest.mark.parametrize("degrees", [15.0, 45.0, 90.0])
def test_matches_survive_any_rotation(degrees: float) -> None:
    grey = texture(seed=8)
    other, motion = turned(grey, degrees)
    options = FeatureOptions(kind="surf", max_features=800)
    found = match(detect(grey, options), detect(other, options), 0.8)
    error = np.linalg.norm(found.points1 @ motion[:, :2].T + motion[:, 2] - found.points2, axis=1)
    assert (error < 1.0).sum() > 180
    assert np.mean(error < 3.0) > 0.95
    assert np.median(error) < 0.35
    assert set(detect(grey, options).laplacian_sign) == {-1, 1}
