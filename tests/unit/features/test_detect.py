"""Detection: how many features, where, in tiles, of crossings, and after contrast is raised."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import rdstitch
from rdstitch.arrays import FloatArray
from rdstitch.choices import FeatureName
from rdstitch.errors import ArgumentError
from rdstitch.features import FeatureOptions, Features, PackedFeatures, View, detect, detect_view, match
from rdstitch.features.crossings import find_crossings
from rdstitch.features.detect import spread, strongest
from rdstitch.features.opencv import detect_opencv
from rdstitch.features.prepared_image import common_stretch, halving, prepare, usual_stretch
from rdstitch.features.sift_tiles import detect_sift_in_tiles
from rdstitch.geometry.camera import Camera
from rdstitch.synthetic import ImageTexture, Photometry, grid_poses, ground, sequence_over
from tests.cli.running import flight

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
def test_a_turned_image_matches(kind: FeatureName, image: NDArray[np.uint8]) -> None:
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
def test_an_image_with_few_features_is_detected_at_a_larger_size(image: NDArray[np.uint8], kind: FeatureName) -> None:
    options = FeatureOptions(kind=kind, work_megapixels=0.02)
    small = cv2.resize(image, (90, 75), interpolation=cv2.INTER_AREA)
    found = len(detect(small, FeatureOptions(kind=kind, work_megapixels=None)))
    assert len(detect(image, replace(options, max_features=2 * found))) <= found
    assert len(detect(image, replace(options, max_features=2 * found + 2))) > 1.5 * found


@pytest.mark.parametrize("kind", ["sift", "surf"])
@pytest.mark.parametrize("work_megapixels", [None, 0.1])
def test_a_blob_is_where_it_is_at_any_working_size(kind: FeatureName, work_megapixels: float | None) -> None:
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
def test_a_blank_image_has_no_features(kind: FeatureName, shape: tuple[int, ...]) -> None:
    found = detect(np.full(shape, 90, np.uint8), FeatureOptions(kind=kind))
    assert found.points.shape == (0, 2)
    assert found.descriptors.shape[0] == 0
    assert found.descriptors.shape[1] >= 32
    assert len(match(found, found)) == 0


@pytest.mark.parametrize("kind", ["rootsift", "surf", "orb"])
def test_nothing_is_seen_behind_a_mask(kind: FeatureName, image: NDArray[np.uint8]) -> None:
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


def test_any_float_and_any_order_of_bytes_has_the_same_features(image: NDArray[np.uint8]) -> None:
    grey, options = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8), FeatureOptions(work_megapixels=0.02)
    for same in ((np.float32, ">f4", np.float16, np.float64, np.longdouble), (np.uint16, ">u2")):
        points = [detect(grey.astype(kind), options).points for kind in same]
        assert len(points[0]) > 20
        for found in points[1:]:
            np.testing.assert_array_equal(found, points[0])


def test_grey_layouts_agree(image: NDArray[np.uint8]) -> None:
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    opaque = np.full_like(grey, 255)
    reference = detect(grey)
    for layout in (image, grey[..., None], np.dstack([grey, opaque]), np.dstack([image, opaque])):
        assert same(reference, detect(layout))


@pytest.mark.parametrize("enlarged", [1, 5])  # whole, and in tiles
def test_sift_tells_dark_blobs_from_light_ones(enlarged: int) -> None:
    row, column = np.indices((240, 320))
    away2, sigma = (row % 80 - 40) ** 2 + (column % 80 - 40) ** 2, 3.0 + column // 80
    grey = 128.0 + np.where(row // 80 == 1, -100.0, 100.0) * np.exp(-away2 / (2.0 * sigma**2))
    large = cv2.resize(np.rint(grey).astype(np.uint8), None, fx=enlarged, fy=enlarged)
    found = detect(large, FeatureOptions(work_megapixels=None))
    points = (found.points + 0.5) / enlarged - 0.5
    blobs = found.take(np.flatnonzero(np.linalg.norm(points % 80 - 40, axis=1) < 1.0))
    assert len(np.unique(blobs.points, axis=0)) >= 12
    np.testing.assert_array_equal(blobs.laplacian_sign, np.where(blobs.points[:, 1] // (80 * enlarged) == 1, 1, -1))


@pytest.mark.parametrize("kind", ["rootsift", "surf", "orb", "akaze"])
def test_threads_change_nothing(kind: FeatureName, image: NDArray[np.uint8]) -> None:
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
def test_what_opencv_lacks(monkeypatch: pytest.MonkeyPatch, remove: Callable[[pytest.MonkeyPatch], None]) -> None:
    remove(monkeypatch)
    with pytest.raises(ArgumentError, match="'orb' are not in this OpenCV"):
        detect(np.zeros((50, 50), np.uint8), FeatureOptions(kind="orb"))


def test_a_fourth_band_of_a_view_is_no_alpha() -> None:
    bands = np.zeros((40, 50, 4), np.uint8)
    assert prepare(View(bands), None).clearance is None
    assert prepare(View.of(bands), None).clearance is not None


def test_bad_arguments_are_refused(image: NDArray[np.uint8]) -> None:
    for options in ({"kind": "surfing"}, {"max_features": 0}, {"work_megapixels": -1.0}):
        with pytest.raises(ArgumentError):
            FeatureOptions(**options)
    for masked in (image, np.dstack([image, image])):
        with pytest.raises(ArgumentError, match="mask of shape"):
            detect(masked, mask=np.ones((3, 3), bool))
    for bad in (np.zeros((0, 5), np.uint8), np.zeros((5, 5, 5, 5), np.uint8), np.zeros(5, np.uint8)):
        with pytest.raises(ArgumentError, match="expected an image"):
            detect(bad)
    with pytest.raises(ArgumentError, match="int32"):
        detect(np.zeros((50, 50), np.int32))
    with pytest.raises(ArgumentError, match="int32"):
        detect(np.zeros((50, 50), np.int32), FeatureOptions(work_megapixels=0.001))


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


def test_few_images_share_what_eight_would_have_and_what_is_given_is_kept() -> None:
    for count, share in ((1, 4.0), (2, 4.0), (4, 2.0), (5, 1.6), (8, 1.0), (9, 1.0), (300, 1.0)):
        features, megapixels = FeatureOptions().for_images(count).limits
        assert features == round(2000 * min(share, 2.0))
        assert megapixels == pytest.approx(0.6 * share)
    assert FeatureOptions(max_features=700).for_images(2).limits == (700, 2.4)
    assert FeatureOptions(work_megapixels=None).for_images(2).limits == (4000, None)
    assert FeatureOptions(work_megapixels=0.3).for_images(2).limits == (4000, 0.3)
    # A run on seven of two images' options is that on two.
    two = FeatureOptions().for_images(2)
    assert two.for_images(7) == two


OPTIONS = FeatureOptions()


@pytest.fixture(scope="module")
def grey() -> NDArray[np.uint8]:
    """Ground, as sharp as a lens leaves it, of two tiles by two."""
    texture = np.asarray(cv2.GaussianBlur(ground((1280, 800), 5, 1).region(0, 0, 1280, 800), (0, 0), 1.0))
    return np.asarray(np.clip(np.rint(texture.reshape(800, 1280) * 255), 0, 255), np.uint8)


def test_keypoints_of_tiles_are_those_of_the_whole(grey: NDArray[np.uint8]) -> None:
    """No fine one is lost, or found twice, where tiles meet; and each is described as in the whole."""
    whole, tiles = detect_opencv(grey, OPTIONS), detect_sift_in_tiles(grey, OPTIONS)
    fine, small = (np.flatnonzero(found.scale < 6.5) for found in (whole, tiles))
    assert len(fine) == len(small) > 3000
    distance, partner = map(np.asarray, cKDTree(tiles.points[small]).query(whole.points[fine]))
    assert distance.max() < 0.01
    some = np.arange(0, len(fine), 40)
    one, two = whole.describe(fine[some]), tiles.describe(np.unique(small[partner[some]]))
    # Several keypoints at one place differ in their orientation.
    place = [np.column_stack([f.points, 10 * np.cos(f.angle), 10 * np.sin(f.angle)]) for f in (one, two)]
    distance, partner = map(np.asarray, cKDTree(place[1]).query(place[0]))
    same = distance < 0.01
    assert same.mean() > 0.7
    assert (np.abs(one.descriptors[same] - two.descriptors[partner[same]]).max(axis=1) <= 3).mean() > 0.99

    for low, high in ((8.0, 16.0), (16.0, 64.0)):
        wanted, given = (found.response[(found.scale >= low) & (found.scale < high)] for found in (whole, tiles))
        assert len(given) == pytest.approx(len(wanted), rel=0.15)
        assert np.median(given) == pytest.approx(np.median(wanted), rel=0.1)


_SQUARES, _SUBPIXELS = 8, 6


def _oblique_board(tilt: float, size: tuple[int, int] = (400, 300)) -> tuple[NDArray[np.uint8], FloatArray]:
    """A board of 8 x 8 squares of 30 pixels in its middle, and its inner corners, pixels."""
    to_board = np.array([[0.05 / 1.5, 0.004, 0.0], [-0.006, 0.05 / 1.5, 0.0], [tilt * 1e-3, tilt * 5e-4, 1.0]])
    middle = np.array([199.3, 150.2])
    u, v = ((np.arange(side * _SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5 for side in size)
    points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2) - middle
    seen = np.column_stack([points, np.ones(len(points))]) @ to_board.T
    x, y = (seen[:, :2] / seen[:, 2:] + _SQUARES / 2).T
    inside = (x > 0) & (x < _SQUARES) & (y > 0) & (y < _SQUARES)
    grey = np.where(inside, 40.0 + 160.0 * ((np.floor(x) + np.floor(y)) % 2), 120.0)
    grey = grey.reshape(size[1], _SUBPIXELS, size[0], _SUBPIXELS).mean(axis=(1, 3))
    grey = grey + np.random.default_rng(0).normal(0.0, 2.0, grey.shape)
    inner = np.stack(np.meshgrid(*[np.arange(1, _SQUARES) - _SQUARES / 2] * 2), axis=-1).reshape(-1, 2)
    corners = np.column_stack([inner, np.ones(len(inner))]) @ np.linalg.inv(to_board).T
    return np.rint(grey).astype(np.uint8), corners[:, :2] / corners[:, 2:] + middle


@pytest.mark.parametrize("tilt", [0.0, 2.0])
def test_the_corners_of_a_board_are_found(tilt: float) -> None:
    grey, corners = _oblique_board(tilt)
    found = find_crossings(prepare(View(grey), None))
    distance = np.linalg.norm(found[:, None] - corners, axis=2).min(axis=0)
    assert distance.max() < 0.15
    assert np.sqrt(np.mean(distance**2)) < 0.05
    assert len(found) < 2 * len(corners)


def test_what_is_masked_or_shows_nothing_has_none() -> None:
    assert find_crossings(prepare(View(np.full((60, 80), 90, dtype=np.uint8)), None)).shape == (0, 2)
    grey, corners = _oblique_board(0.0)
    mask = np.ones(grey.shape, dtype=np.bool_)
    mask[:, :200] = False
    found = find_crossings(prepare(View(grey, mask), None))
    assert len(found) >= np.sum(corners[:, 0] > 206)
    assert found[:, 0].min() > 200


@pytest.mark.parametrize(("kind", "bytes_each"), [("rootsift", (1, 2)), ("sift", (1,)), ("orb", (1,)), ("surf", (2,))])
def test_packed_features_match_as_before(
    kind: FeatureName, bytes_each: tuple[int, ...], image: NDArray[np.uint8]
) -> None:
    options = FeatureOptions(kind=kind, max_features=500)
    features = [detect(image, options), detect(np.ascontiguousarray(image[:, 40:]), options)]
    packed = [PackedFeatures.pack(found) for found in features]
    again = [found.unpack() for found in packed]
    assert packed[0].descriptors.itemsize in bytes_each
    assert again[0].binary is features[0].binary
    before, after = (match(first, second) for first, second in (features, again))
    if kind in ("rootsift", "sift", "orb"):
        np.testing.assert_array_equal(again[0].descriptors, features[0].descriptors)
    common = set(map(tuple, before.indices.tolist())) & set(map(tuple, after.indices.tolist()))
    assert len(common) >= 0.98 * len(before) > 50


def test_integers_beyond_a_byte_and_numbers_beyond_half_precision_are_kept() -> None:
    one = detect(np.zeros((1, 1), np.uint8), FeatureOptions())
    values = np.zeros((3, 8), np.float32)
    for largest, kind in ((255.0, np.uint8), (400.0, np.float16), (1e6, np.float32), (0.5, np.float16)):
        values[1, 2] = largest
        numbers = np.arange(3.0)
        features = type(one)(np.zeros((3, 2)), values, numbers, numbers, numbers, None, "made up")
        packed = PackedFeatures.pack(features)
        assert packed.descriptors.dtype == kind
        np.testing.assert_array_equal(packed.unpack().descriptors, values)


_OPTIONS = rdstitch.StitchOptions(workers=1, channel_order="rgb", features=rdstitch.FeatureOptions(max_features=800))


@pytest.fixture(scope="module")
def frames() -> list[NDArray[np.uint8]]:
    sequence = flight(3, 3)
    return [sequence.frame(index) for index in range(3)]


def _hazy(frames: list[NDArray[np.uint8]]) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng(0)
    return [
        np.clip(np.rint(150 + (frame - 128.0) / 10 + rng.normal(0.0, 0.7, frame.shape)), 0, 255).astype(np.uint8)
        for frame in frames
    ]


def test_a_tenth_of_the_contrast_with_noise_is_seen_and_said(frames: list[NDArray[np.uint8]]) -> None:
    hazy = _hazy(frames)
    clear, found = (rdstitch.calibrate(images, _OPTIONS) for images in (frames, hazy))
    assert found.alignment.used.all()
    assert any(message.code == "low-contrast" for message in found.messages)
    assert not any(message.code == "low-contrast" for message in clear.messages)
    assert clear.stretch is None
    deviation = np.hypot(clear.alignment.distortion_std, found.alignment.distortion_std)
    assert abs(clear.alignment.distortion - found.alignment.distortion) < 3 * deviation
    # Who says that nothing is to be equalized is obeyed.
    plain = replace(_OPTIONS, features=replace(_OPTIONS.features, equalize=False))
    try:
        as_it_is = rdstitch.calibrate(hazy, plain)
    except rdstitch.RdstitchError:
        return
    assert sum(as_it_is.keypoints) < sum(found.keypoints) / 2


def test_a_single_image_of_little_contrast_is_seen_and_named(frames: list[NDArray[np.uint8]]) -> None:
    clear, found = (rdstitch.calibrate(k, _OPTIONS) for k in (frames, [frames[0], _hazy(frames)[1], frames[2]]))
    assert found.alignment.used.all()
    assert found.keypoints[::2] == clear.keypoints[::2]
    assert found.keypoints[1] > clear.keypoints[1] / 2
    (message,) = [message for message in found.messages if message.code == "low-contrast"]
    assert message.images == (str(found.sources[1].path),)
    assert message.text.startswith("shows little contrast")


def test_deep_images_register_as_their_common_rendering_does(frames: list[NDArray[np.uint8]]) -> None:
    """Each image's own stretch would undo that the second one is darker."""
    darker = [np.rint(f.mean(axis=2) * gain).astype(np.uint8) for f, gain in zip(frames, (1.0, 0.5, 0.9), strict=True)]
    low, high = common_stretch(usual_stretch(View(frame)) for frame in darker) or (0.0, 255.0)
    rendered = [np.clip(np.rint((f - low) * 255.0 / (high - low)), 0, 255).astype(np.uint8) for f in darker]
    deep = [frame.astype(np.uint16) * 40 + 1000 for frame in darker]
    first, second = (rdstitch.calibrate(images, _OPTIONS) for images in (rendered, deep))
    assert second.stretch == pytest.approx((low * 40 + 1000, high * 40 + 1000))
    assert first.keypoints == second.keypoints
    np.testing.assert_allclose(first.alignment.homographies, second.alignment.homographies, atol=1e-9)


def test_an_image_unlike_the_rest_does_not_decide() -> None:
    usual = [(100.0, 900.0)] * 19
    assert common_stretch([*usual, (0.0, 65535.0)]) == (100.0, 900.0)
    assert common_stretch([None, (5.0, 9.0)]) == (5.0, 9.0)
    assert common_stretch([None]) is None
    assert usual_stretch(View(np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.bool_))) is None


@pytest.mark.slow
def test_a_board_shows_few_features_but_no_little_contrast() -> None:
    """Equalized, the noise of its plain squares would drown them."""
    lens = Camera((640, 480), distortion=-0.25, focal=600.0)
    squares = np.kron(np.indices((10, 16)).sum(axis=0) % 2, np.ones((110, 110)))
    poses = grid_poses(lens, 3, 1, overlap=0.7, yaw=0.2, shift=0.05, seed=3).shaken(seed=4, tilt=0.12)
    plane = ImageTexture((60 + 130 * squares).astype(np.uint8))
    frames = sequence_over(plane, lens, poses, photometry=Photometry(noise=0.012, blur=0.7)).frames() * 3
    found = rdstitch.calibrate(frames, rdstitch.StitchOptions(workers=1))
    assert not any(message.code == "low-contrast" for message in found.messages)
    assert found.alignment.used.all()


def test_that_there_are_more_pixels_is_no_contrast(frames: list[NDArray[np.uint8]]) -> None:
    hazy = _hazy(frames)[0]
    options = FeatureOptions(max_features=800, work_megapixels=hazy.shape[0] * hazy.shape[1] / 1e6)
    small, large = (detect(np.kron(hazy, np.ones((k, k, 1), np.uint8)), options) for k in (1, 2))
    assert small.detected_count == large.detected_count
    assert small.low_contrast
    assert large.low_contrast
    blank = detect(np.zeros((40, 40), np.uint8), options)
    assert blank.detected_count == 0
    assert blank.low_contrast
    clear = detect(frames[0], options)
    assert (clear.detected_count or 0) > 400
    assert not clear.low_contrast
