"""Features lie where they should, keep clear of masks, and do not depend on threads."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.errors import ArgumentError
from rdstitch.features import FeatureOptions, Features, View, detect, detect_view, match
from rdstitch.features.detect import spread, strongest
from rdstitch.features.prepared_image import halving
from rdstitch.synthetic import ground

KINDS = ("rootsift", "sift", "surf", "orb", "akaze")
WIDTH, HEIGHT = 360, 300


@pytest.fixture(scope="module")
def image() -> NDArray[np.uint8]:
    """Ground, as sharp as a lens leaves it, RGB."""
    colour = ground((WIDTH, HEIGHT), 11, 3).region(0, 0, WIDTH, HEIGHT)
    smooth = np.asarray(cv2.GaussianBlur(colour, (0, 0), 1.0))
    return np.asarray(np.clip(np.rint(smooth * 255), 0, 255), np.uint8)


def same(a: Features, b: Features) -> bool:
    return np.array_equal(a.points, b.points) and np.array_equal(a.descriptors, b.descriptors)


@pytest.mark.parametrize("kind", KINDS)
def test_a_turned_image_matches(kind: str, image: NDArray[np.uint8]) -> None:
    motion = np.asarray(cv2.getRotationMatrix2D(((WIDTH - 1) / 2, (HEIGHT - 1) / 2), 20.0, 1.0), np.float64)
    turned = np.asarray(cv2.warpAffine(image, motion, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC), np.uint8)
    options = FeatureOptions(kind=kind, max_features=1500)
    one, two = detect(image, options), detect(turned, options)
    assert one.kind == kind
    assert one.image_size == (WIDTH, HEIGHT)
    assert (np.diff(one.response) <= 0).all()
    assert (one.angle >= 0).all()
    assert (one.angle < 2 * np.pi).all()
    found = match(one, two, 0.8)
    error = np.linalg.norm(found.points1 @ motion[:, :2].T + motion[:, 2] - found.points2, axis=1)
    assert (error < 2).sum() > 50
    assert np.mean(error < 3) > 0.9
    # Points have no bias: half a pixel would be a wrong convention.
    bias = (found.points1 @ motion[:, :2].T + motion[:, 2] - found.points2)[error < 2].mean(axis=0)
    assert np.abs(bias).max() < 0.12


@pytest.mark.parametrize("size", [(3265, 2449), (6532, 4898), (4001, 1999), (2001, 1000)])
def test_an_image_that_was_read_smaller_is_worked_on_at_the_same_size(size: tuple[int, int]) -> None:
    factor = halving(size, 2.0)
    width, height = (-(-n // factor) for n in size)
    assert width * height <= 2e6
    for read in (2**k for k in range(factor.bit_length())):
        assert read * halving((-(-size[0] // read), -(-size[1] // read)), 2.0) == factor


@pytest.mark.parametrize("kind", ["rootsift", "orb"])
def test_an_image_with_few_features_is_detected_at_a_larger_size(image: NDArray[np.uint8], kind: str) -> None:
    options = FeatureOptions(kind=kind, work_megapixels=0.02)
    small = cv2.resize(image, (90, 75), interpolation=cv2.INTER_AREA)
    found = len(detect(small, FeatureOptions(kind=kind, work_megapixels=None)))
    assert len(detect(image, replace(options, max_features=2 * found))) <= found
    assert len(detect(image, replace(options, max_features=2 * found + 2))) > 1.5 * found


@pytest.mark.parametrize("kind", ["sift", "surf"])
@pytest.mark.parametrize("work_megapixels", [None, 0.1])
def test_a_blob_is_where_it_is_at_any_working_size(kind: str, work_megapixels: float | None) -> None:
    v, u = np.mgrid[:480, :641]
    center, sigma = (300.3, 212.4), 18.0
    grey = np.rint(60 + 150 * np.exp(-((u - center[0]) ** 2 + (v - center[1]) ** 2) / (2 * sigma**2)))
    found = detect(grey.astype(np.uint8), FeatureOptions(kind=kind, work_megapixels=work_megapixels))
    strongest_point = found.points[found.response.argmax()]
    np.testing.assert_allclose(strongest_point, center, atol=0.5)
    # Diameters are in px of the full size, too.
    assert 1.5 * sigma < found.scale[found.response.argmax()] < 8 * sigma


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(240, 320), (240, 320, 3), (7, 5), (1, 1)])
def test_a_blank_image_has_no_features(kind: str, shape: tuple[int, ...]) -> None:
    found = detect(np.full(shape, 90, np.uint8), FeatureOptions(kind=kind))
    assert found.points.shape == (0, 2)
    assert found.descriptors.shape[0] == 0
    assert found.descriptors.shape[1] >= 32
    assert len(match(found, found)) == 0


@pytest.mark.parametrize("kind", ["rootsift", "surf", "orb"])
def test_nothing_is_seen_behind_a_mask(kind: str, image: NDArray[np.uint8]) -> None:
    allowed = np.ones((HEIGHT, WIDTH), dtype=bool)
    allowed[100:220, 60:200] = False
    covered = image.copy()
    covered[~allowed] = np.random.default_rng(0).integers(0, 256, (int((~allowed).sum()), 3))
    alpha = np.dstack([covered, np.where(allowed, 255, 0).astype(np.uint8)])
    number = covered.astype(np.float32)
    number[~allowed] = np.nan
    options = FeatureOptions(kind=kind, work_megapixels=0.08, max_features=4000)
    masked = detect(covered, options, allowed)
    u, v = np.rint(masked.points).astype(int).T
    # The mask is judged in pixels of working size, here 1.2 px large.
    radius = np.maximum(masked.scale / 2 - 1.8, 0)
    assert len(masked) > 100
    for dx, dy in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        x, y = np.rint(masked.points + np.column_stack([radius * dx, radius * dy])).astype(int).T
        inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
        assert allowed[y[inside], x[inside]].all()
    assert same(masked, detect(covered, options, np.where(allowed, 255, 0).astype(np.uint8)))
    assert same(masked, detect(alpha, options))
    assert not allowed[v, u].all() or len(detect(covered, options)) > len(masked)
    float_points = detect(number, options).points
    x, y = np.rint(float_points).astype(int).T
    assert len(float_points) > 100
    assert allowed[y, x].all()


def test_deeper_images_are_stretched(image: NDArray[np.uint8]) -> None:
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    options = FeatureOptions(max_features=4000)
    reference = detect(grey, options)
    for deep in (grey.astype(np.uint16) * 16 + 100, grey.astype(np.float64) / 1000, grey.astype(np.float32) * 9):
        found = match(reference, detect(deep, options), 0.8)
        assert len(found) > 0.8 * len(reference)
        assert np.median(np.linalg.norm(found.points1 - found.points2, axis=1)) < 0.05


def test_grey_layouts_agree(image: NDArray[np.uint8]) -> None:
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    opaque = np.full_like(grey, 255)
    reference = detect(grey)
    for layout in (image, grey[..., None], np.dstack([grey, opaque]), np.dstack([image, opaque])):
        assert same(reference, detect(layout))


@pytest.mark.parametrize("kind", ["rootsift", "surf", "orb", "akaze"])
def test_threads_change_nothing(kind: str, image: NDArray[np.uint8]) -> None:
    options = FeatureOptions(kind=kind, max_features=700)
    sources = [lambda _, i=i: View(np.rot90(image, i).copy()) for i in range(4)]
    one = [detect_view(source, options) for source in sources]
    with ThreadPoolExecutor(3) as pool:
        several = list(pool.map(lambda source: detect_view(source, options), sources))
    before = cv2.getNumThreads()
    for threads in (1, 4):
        cv2.setNumThreads(threads)
        assert same(detect(image, options), one[0])
    cv2.setNumThreads(before)
    assert all(same(a, b) for a, b in zip(one, several, strict=True))
    assert one[1].image_size == (HEIGHT, WIDTH)


def raising(*_arguments: object, **_options: object) -> None:
    raise cv2.error("The function/feature is not implemented")


@pytest.mark.parametrize("remove", [lambda m: m.delattr(cv2, "ORB"), lambda m: m.setattr(cv2.ORB, "create", raising)])
def test_a_detector_that_opencv_lacks_is_named(
    monkeypatch: pytest.MonkeyPatch, remove: Callable[[pytest.MonkeyPatch], None]
) -> None:
    remove(monkeypatch)
    with pytest.raises(ArgumentError, match="'orb' are not in this OpenCV"):
        detect(np.zeros((50, 50), np.uint8), FeatureOptions(kind="orb"))


def test_bad_arguments_are_refused(image: NDArray[np.uint8]) -> None:
    for options in (
        {"kind": "surfing"},
        {"max_features": 0},
        {"work_megapixels": 0.0},
        {"spread_cell": 0.0},
        {"surf_layers": 0},
    ):
        with pytest.raises(ArgumentError):
            FeatureOptions(**options)
    with pytest.raises(ArgumentError, match="mask of shape"):
        detect(image, mask=np.ones((3, 3), bool))
    for bad in (np.zeros((0, 5), np.uint8), np.zeros((5, 5, 5, 5), np.uint8), np.zeros(5, np.uint8)):
        with pytest.raises(ArgumentError, match="expected an image"):
            detect(bad)
    with pytest.raises(ArgumentError, match="int32"):
        detect(np.zeros((50, 50), np.int32))


def test_spreading_serves_every_cell_before_any_twice() -> None:
    rng = np.random.default_rng(1)
    points = np.vstack([rng.uniform(0, 100, (900, 2)), rng.uniform(0, 1000, (300, 2))])
    response = np.concatenate([rng.uniform(10, 20, 900), rng.uniform(0, 5, 300)])
    chosen = spread(points, response, 200, cell=100.0)
    assert len(set(chosen)) == 200
    assert (np.diff(response[chosen]) <= 0).all()
    column, row = (points // 100).astype(int).T
    cell = 10 * row + column
    available, taken = np.bincount(cell, minlength=100), np.bincount(cell[chosen], minlength=100)
    fewest = taken[available > taken].min()
    assert taken.max() <= fewest + 1
    for number in range(100):
        inside = np.flatnonzero(cell == number)
        best = inside[np.argsort(-response[inside])][: taken[number]]
        assert set(best) == set(chosen[cell[chosen] == number])
    assert (strongest(response, 200) < 900).all()


def test_spreading_fills_the_corners(image: NDArray[np.uint8]) -> None:
    dim = image.astype(np.float64)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    radius = np.hypot(u - WIDTH / 2, v - HEIGHT / 2) / np.hypot(WIDTH / 2, HEIGHT / 2)
    dim = np.rint(128 + (dim - 128) * (1 - 0.75 * radius**2)[..., None]).astype(np.uint8)
    share = {}
    for wanted in (True, False):
        points = detect(dim, FeatureOptions(max_features=300, spread=wanted)).points
        assert len(points) == 300
        outside = np.hypot(*(points - [WIDTH / 2, HEIGHT / 2]).T) > 0.75 * np.hypot(WIDTH / 2, HEIGHT / 2)
        share[wanted] = outside.mean()
    assert share[True] > 1.5 * share[False]
