"""Overlaps, the light that they tell, the seams in them, and pixels that stay with the camera."""

from collections.abc import Sequence
from itertools import combinations, product
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from examples.worlds.compositing_scenes import as_image, loader, place_images, render, side_by_side
from rdstitch.arrays import FloatArray
from rdstitch.compositing import cell_least_squares, field_fit, gain_compensation, overlap_cells, plan_canvas
from rdstitch.compositing.boxes import intersection, overlapping_pairs
from rdstitch.compositing.gain_compensation import estimate_exposure
from rdstitch.compositing.gain_fit import Differences, fit_gain_and_vignetting
from rdstitch.compositing.overlap_cells import compare_overlaps
from rdstitch.compositing.photometric import Exposure, full_scale, no_exposure
from rdstitch.compositing.seam_finder import find_seams
from rdstitch.compositing.source_images import ImageReader, PlacedImage
from rdstitch.compositing.static_pixels import static_pixels
from rdstitch.compositing.survey import Survey, survey_images
from rdstitch.compositing.warp import locate, plan_warp
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.numerics.conjugate_gradients import conjugate_gradients
from rdstitch.synthetic import ground
from rdstitch.synthetic.rendering import Photometry
from tests.sampled import sampled


@pytest.mark.parametrize("shape", [(300, 80), (80, 300)])
def test_all_pairs_of_boxes_with_pixels_in_common(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    corners = rng.integers(0, shape, (60, 2))
    boxes = [None if k % 9 == 4 else (int(x), int(y), int(x) + 30, int(y) + 20) for k, (x, y) in enumerate(corners)]
    expected = sorted(
        (j, i)
        for (i, a), (j, b) in combinations(enumerate(boxes), 2)
        if a is not None and b is not None and intersection(a, b) is not None
    )
    assert [tuple(pair) for pair in overlapping_pairs(boxes, most=60).tolist()] == expected
    assert len(overlapping_pairs([None, boxes[0]])) == len(overlapping_pairs([])) == 0


def test_of_images_in_two_places_each_keeps_few_neighbours_and_the_places_stay_connected() -> None:
    stacks = [(x + k % 3, k // 3, x + k % 3 + 100, k // 3 + 100) for x in (0, 96) for k in range(60)]
    pairs = overlapping_pairs(stacks, most=5)
    assert len(pairs) <= 120 * 5 + 119
    assert ((pairs[:, 0] >= 60) & (pairs[:, 1] < 60)).any()


def _row(count: int, width: int = 32) -> tuple[Survey, list[PlacedImage]]:
    """Images side by side, tiny or so wide, each half over the next, and by turns darker and brighter."""
    lens = Camera((width, 3 * width // 4), distortion=0.0, focal=float(width))
    frames = [np.full((3 * width // 4, width, 3), 100 + 20 * (k % 2), dtype=np.uint8) for k in range(count)]
    step = width / 2 / lens.scale
    places = np.array([[[1, 0, k * step], [0, 1, 0], [0, 0, 1]] for k in range(count)], dtype=np.float64)
    cameras = [lens] * count
    images = place_images([loader(as_image(frame)) for frame in frames], cameras, places)
    return survey_images(ImageReader(images), images, plan_canvas(cameras, places)), images


def test_what_is_compared_is_linear_in_the_number_of_images() -> None:
    """Two neighbours an image in a row."""
    count = 200
    survey, images = _row(count)
    cells = compare_overlaps(survey)
    assert cells.overlap.nnz == 2 * (count - 1)
    exposure = gain_compensation.estimate_exposure(survey, images)
    means = exposure.log_gain.mean(axis=1)
    assert (means[1::2] > means[::2]).all()


@pytest.mark.parametrize("width", [64, 640])
def test_cells_are_spread_over_the_overlap_of_images_of_any_size(width: int) -> None:
    cells = compare_overlaps(_row(2, width)[0])
    first, second = cells.points
    np.testing.assert_allclose(np.abs(first - second), np.tile([width / 2, 0.0], (len(first), 1)), atol=1e-6)
    np.testing.assert_array_less(0.75 * np.array([width / 2, 3 * width / 4]), np.ptp(first, axis=0))


def test_gains_of_thousands_of_overlaps_take_a_few_cells_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    survey, images = _row(60)
    of_all = gain_compensation.estimate_exposure(survey, images, "gain").log_gain
    monkeypatch.setattr(overlap_cells, "_MAX_CELLS", 600)
    cells = compare_overlaps(survey)
    assert 59 <= len(cells.pair) <= 600
    np.testing.assert_allclose(gain_compensation.estimate_exposure(survey, images, "gain").log_gain, of_all, atol=1e-3)


def test_exposure_is_the_same_by_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overlap_cells, "_PAIRS_AT_A_TIME", 3)
    survey, images = _row(12)
    one, several = (gain_compensation.estimate_exposure(survey, images, workers=workers) for workers in (1, 3))
    np.testing.assert_array_equal(one.log_gain, several.log_gain)
    np.testing.assert_array_equal(one.fields, several.fields)


def test_steps_to_the_fields_hardly_grow_with_the_number_of_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """What all images of a row have in common need not go from each to the next."""
    steps = []

    def counted(matrix: Any, right: Any, start: Any, precondition: Any, *rest: Any) -> Any:
        steps.append(0)

        def once(left: FloatArray) -> Any:
            steps[-1] += 1
            return precondition(left)

        return conjugate_gradients(matrix, right, start, once, *rest)

    monkeypatch.setattr(cell_least_squares, "conjugate_gradients", counted)
    most = []
    for count in (8, 128):
        survey, images = _row(count)
        cells = compare_overlaps(survey)
        brighter = 0.3 * np.sin(np.linspace(0.0, 2.0 * np.pi, count))[cells.images]
        steps.clear()
        field_fit.fit_fields(
            cells, (brighter[0] - brighter[1])[:, None].repeat(3, axis=1), [image.camera for image in images]
        )
        most.append(max(steps))
    assert most[1] <= 1.5 * most[0]


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
    assert no_exposure(2, 3).correct(1, GEOMETRY, samples) is samples


@pytest.mark.parametrize("fields", [np.zeros((0, 0, 0, 0)), np.full((2, 3, 3, 3), -0.1)], ids=["gain", "fields"])
def test_nothing_but_full_scale_becomes_full_scale(fields: FloatArray) -> None:
    """Brightened samples are compressed from the knee on, in order, and darkened ones are as without it."""
    ramp = np.broadcast_to(np.arange(80, dtype=np.uint16)[:, None, None] * 831 - 114, (80, 100, 3)).astype(np.uint16)
    ramp = np.sort(np.clip(ramp, 0, 65535), axis=0)
    ramp[-1] = 65535
    gains = np.array([[0.0] * 3, [-0.3, -0.1, 0.4]])
    compressed, clipped = (Exposure(OFFSET, gains, fields=fields, white=w).correct(1, GEOMETRY, ramp) for w in (9, 1))
    assert (np.diff(compressed.astype(int), axis=0) > 0).all()
    assert (compressed[-1, :, :2] == 65535).all()
    assert (compressed[:-1, :, :2] < 65535).all()
    assert (clipped[:-1, :, 0] == 65535).any()
    below = clipped < 0.74 * 65535
    assert np.abs(compressed[below].astype(int) - clipped[below]).max() <= 1
    np.testing.assert_array_equal(compressed[..., 2], clipped[..., 2])


@pytest.mark.parametrize("black", [0.2, 0.8])
def test_most_of_a_scene_may_be_black(black: float) -> None:
    """As of stars, fluorescence or X-rays; what is lit stays as bright as it was."""
    lens = Camera((64, 48), distortion=0.0, focal=64.0)
    ground = np.random.default_rng(2).integers(40, 160, (48, 96, 3)) * np.ones((1, 96, 1), np.int64)
    ground[: round(48 * black)] = 0
    frames = [ground[:, :64].astype(np.uint8), (1.5 * ground[:, 32:]).astype(np.uint8)]
    places = np.array([[[1, 0, x / lens.scale], [0, 1, 0], [0, 0, 1]] for x in (0.0, 32.0)])
    images = place_images([loader(as_image(frame)) for frame in frames], [lens] * 2, places)
    survey = survey_images(ImageReader(images), images, plan_canvas([lens] * 2, places))
    gains = np.exp(estimate_exposure(survey, images, "gain").log_gain)
    np.testing.assert_allclose(gains[1] / gains[0], 1.5, rtol=0.03)
    assert 0.75 < gains[0].mean() < 0.95


def test_an_exposure_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ArgumentError, match="not finite"):
        Exposure(0.0, np.full((1, 3), np.nan))


def test_an_image_without_overlap_has_the_gain_that_its_camera_wrote_down() -> None:
    scene = render(3, 1, size=(160, 120), photometry=Photometry(gain=np.array([1.0, 1.0, 2.0]), gamma=2.4), seed=2)
    apart = scene.homographies.copy()
    apart[2] = np.array([[1.0, 0.0, 2000.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ apart[2]
    canvas = plan_canvas(scene.cameras, apart)
    sets = [place_images(scene.sources, scene.cameras, apart, exposure=e) for e in (None, [0.5, 0.5, 1.0])]
    survey = survey_images(ImageReader(sets[0]), sets[0], canvas)
    cells = compare_overlaps(survey)
    differences = Differences.of(cells, 0.055)
    gains = [fit_gain_and_vignetting(differences, images)[0].log_gain for images in sets]
    assert np.abs(gains[0][2]).max() < 0.01
    np.testing.assert_allclose(gains[1][2] - gains[1][:2].mean(axis=0), np.log(2.0) / 2.4, atol=0.02)


SIZE = (300, 200)
SHIFT = 100  # pixels by which the second image lies further right, or down
LEFT, ALIKE, RIGHT = 60, 128, 200


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("place", [180, 200, 220])
def test_a_seam_runs_where_two_images_look_alike(place: int, swapped: bool) -> None:
    """Two plain images of unequal grey that look alike in one column of the overlap alone."""
    column = np.arange(SIZE[0] + SHIFT)
    frames = []
    for grey, start in ((LEFT, 0), (RIGHT, SHIFT)):
        row = np.where(np.abs(column - place) <= 4, ALIKE, grey)[start : start + SIZE[0]].astype(np.uint8)
        frames.append(np.tile(row[None, :, None], (SIZE[1], 1, 3)))
    order = slice(None, None, -1 if swapped else 1)  # whichever is added last
    found = side_by_side(frames[order], [(0, 0), (SHIFT, 0)][order], exposure="none", seam="graphcut", blend="none")
    assert found.canvas.size == (SIZE[0] + SHIFT, SIZE[1])
    assert (found.pixels[:, : place - 6] == LEFT).all()
    assert (found.pixels[:, place + 7 :] == RIGHT).all()


def test_a_seam_avoids_fine_detail_that_is_off_by_a_pixel() -> None:
    """Grain that is the same in both images in a winding path alone; it is even grey in small ones."""
    rng, (width, height, shift) = np.random.default_rng(2), (1200, 900, 400)
    grain = np.repeat(rng.integers(88, 168, (height, width + shift, 1)), 3, axis=2).astype(np.uint8)
    column = np.arange(width + shift)[None, :]
    path = 800 + 60 * np.sin(np.arange(height) / 120)[:, None]
    off = np.where((np.abs(column - path) < 30)[..., None], grain, np.roll(grain, 1, axis=1))
    frames = [grain[:, :width], off[:, shift:]]
    found = side_by_side(frames, [(0, 0), (shift, 0)], exposure="none", blend="none").pixels
    left, right = column < path - 30, column > path + 30
    assert (found == grain).all(axis=-1)[left].mean() > 0.99
    assert (found == off).all(axis=-1)[right].mean() > 0.99


@pytest.mark.parametrize("taken_by", [0, 1])
@pytest.mark.parametrize("x", [150, 210, 240])
def test_a_seam_goes_round_what_moves(x: int, taken_by: int) -> None:
    """Somebody, hardly unlike the ground, whom one image shows anywhere in the overlap: seen whole, or not at all."""
    width, height = SIZE
    texture = (255.0 * ground((width + 120, height), x).region(0, 0, width + 120, height)).astype(np.uint8)
    mask = cv2.ellipse(np.zeros(texture.shape[:2], np.uint8), (x, 105), (28, 60), 0, 0, 360, 1, -1) > 0
    person = np.clip(0.35 * texture + 0.45 * texture.mean(), 0, 255).astype(np.uint8)
    frames = [texture[:, :width].copy(), texture[:, 120:].copy()]
    part = np.s_[:, 120 * taken_by : 120 * taken_by + width]
    frames[taken_by][mask[part]] = person[part][mask[part]]
    found = side_by_side(frames, [(0, 0), (120, 0)], exposure="none", blend="none").pixels.astype(int)
    away, there = (np.abs(found - what).max(axis=2) for what in (texture, person))
    clear = mask & (np.abs(texture.astype(int) - person).max(axis=2) > 6)
    shown = float((there < away)[clear].mean())
    assert min(shown, 1.0 - shown) < 0.02


_WIDTH, _HEIGHT, _COUNT = 200, 150, 5


def _images() -> NDArray[np.float32]:
    """Images (5, h, w) of a plane, each of another place."""
    texture = ground((_WIDTH + 400, _HEIGHT), 3)
    places = [texture.region(90 * k, 0, 90 * k + _WIDTH, _HEIGHT)[:, :, 0] for k in range(_COUNT)]
    noise = np.random.default_rng(1).normal(0.0, 0.01, (_COUNT, _HEIGHT, _WIDTH))
    return np.clip(np.stack(places) + noise, 0.05, 1.0).astype(np.float32)


def test_nothing_stays_where_the_camera_moves_or_hardly_moves() -> None:
    """Neither does a line along the motion, nor what is dark by chance.

    That is numbers below 0, and the dark ground of a microscope, which most of every image shows.
    """
    images, lined = _images(), _images()
    lined[:, 60:64] = 1.0
    lined[:, 90:110] *= 0.4
    below = images - np.quantile(images, 0.7).astype(np.float32)
    for shown in (images, lined, below, np.where(below < 0.0, 0.0, images).astype(np.float32), [images[0]] * 5):
        assert static_pixels(list(shown)) is None


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
    for base in (0.0, -0.8) if shape == "border" else (0.0,):
        assert static_pixels(list(images + np.float32(base)))[region].mean() > 0.95
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


# White paper with text and photographs, and where crops of it lie: x, y, brightness.
PAPER = (320, 240)
_FOUR = ((0, 0), (230, 6), (460, 0), (690, 4))


def _poster(paper: int, seed: int) -> NDArray[np.uint8]:
    rng, sheet = np.random.default_rng(seed), np.full((260, 1020, 3), paper, np.uint8)
    for x in range(40, 900, 190):
        photo = ground((110, 80), seed + x).region(0, 0, 110, 80)
        sheet[130:210, x : x + 110] = (255 * photo).astype(np.uint8)
    for _ in range(220):
        at, text = (int(rng.integers(0, 980)), int(rng.integers(10, 255))), "".join(rng.choice(list("abcdefgh"), 3))
        cv2.putText(sheet, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.35, (30, 30, 30), 1)
    return sheet


def _crops(
    sheet: NDArray[np.uint8], places: Sequence[tuple[int, int]], light: Sequence[float]
) -> list[NDArray[np.uint8]]:
    """Photographs of the sheet, each of another brightness, with noise."""
    rng, frames = np.random.default_rng(5), []
    for (x, y), factor in zip(places, light, strict=True):
        part = sheet[y : y + PAPER[1], x : x + PAPER[0]] * factor
        noise = rng.normal(0.0, 0.7, part.shape) * (part < 254.5)
        frames.append(np.clip(np.rint(part + noise), 0, 255).astype(np.uint8))
    return frames


def _paper_in(sheet: NDArray[np.uint8], paper: int, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Where there is nothing but paper, not even near by."""
    other = (sheet != paper).any(axis=2).astype(np.uint8)
    return np.asarray(cv2.dilate(other, np.ones((7, 7), np.uint8)) == 0)[: shape[0], : shape[1]]


BLOCKS = [(200, 120, 20), (60, 60, 60), (250, 220, 170)]
CORNERS = [(0, 20), (60, 0), (200, 90)]


@pytest.mark.parametrize(("corner", "block", "paper"), sampled(list(product(CORNERS, BLOCKS, [255, 240])), 5))
def test_a_block_in_one_image_tints_no_paper(corner: tuple[int, int], block: tuple[int, int, int], paper: int) -> None:
    """A block over up to half of what two equally bright images share, in either."""
    sheet, places = _poster(paper, 3), ((0, 0), (150, 0))
    frames, (x, y) = _crops(sheet, places, (1.0, 1.0)), corner
    shown, left = (frames[1], x - 150) if x > 150 else (frames[0], x + 150)
    shown[y : y + 150, left : left + 110] = block
    found = side_by_side(frames, places, blend="none").pixels.astype(int)
    clean = _paper_in(sheet, paper, found.shape) & (np.abs(found - block).max(axis=2) > 30)
    assert np.abs(found - paper)[clean].max() <= 4


SHADES = [(1, 0.88, 1, 1), (1, 1, 0.85, 1), (0.85, 0.85, 1, 1), (1, 0.94, 0.88, 0.82)]


@pytest.mark.parametrize(("light", "paper"), sampled(list(product(SHADES, [240, 225])), 3))
def test_a_sheet_of_which_one_shot_is_darker_is_as_white_everywhere(light: tuple[float, ...], paper: int) -> None:
    sheet = _poster(paper, 4)
    found = side_by_side(_crops(sheet, _FOUR, light), _FOUR, blend="none").pixels
    clean = _paper_in(sheet, paper, found.shape)
    # Noise apart.
    levels = [np.median(found[:, x : x + 24][clean[:, x : x + 24]]) for x in range(0, found.shape[1] - 24, 24)]
    assert np.ptp(levels) <= 4


def test_a_block_over_half_of_what_a_darker_shot_shares_tints_nothing() -> None:
    """Edges of the block correlate with a photograph by chance: a few cells must not outvote the burnt-out paper."""
    sheet, places, block = _poster(255, 4), _FOUR[:3], (40, 160, 220)
    frames = _crops(sheet, places, (1, 0.85, 1))
    frames[1][60:200, 240:310] = block
    found = side_by_side(frames, places, blend="none").pixels.astype(int)
    clean = _paper_in(sheet, 255, found.shape) & (np.abs(found - block).max(axis=2) > 60) & (found.max(axis=2) > 0)
    assert (found[clean].min(axis=1) >= 247).all()


def test_seams_are_the_same_by_any_number_of_threads() -> None:
    survey, images = _row(8)
    exposure = estimate_exposure(survey, images)
    one, several = (find_seams(survey, exposure, graphcut=True, workers=workers).labels for workers in (1, 3))
    assert set(np.unique(one).tolist()) >= set(range(8))
    np.testing.assert_array_equal(one, several)
