"""Breaks along seams: content that is shifted, and objects that are cut; not what a seam goes around."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rdstitch.arrays import Float32Array
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.likeness import likeness
from rdstitch.compositing.seam_quality import SeamBreak, SeamQuality, SeamTile, measure_seams
from rdstitch.synthetic.textures import ground

SIZE = (400, 300)
SCENE = ground((600, 500), seed=3, channels=1).region(0, 0, 600, 500)[..., 0].astype(np.float32)
SCENE *= np.float32(255.0 / SCENE.max())
PLANKS = SCENE.copy()  # the same with lines that somebody follows
for height in range(-100, 500, 50):
    cv2.line(PLANKS, (0, height), (599, height + 60), (235.0,), 7, cv2.LINE_AA)
LABELS = np.repeat((np.arange(SIZE[0]) >= 200).astype(np.int32)[None], SIZE[1], axis=0)


def _tile(pixels: Float32Array, box: Box) -> SeamTile:
    return SeamTile(box, np.ascontiguousarray(pixels), np.ones(pixels.shape, dtype=np.bool_))


def _quality(second: Float32Array, *, label_size: float = 1.0, unit: float = 1.0) -> SeamQuality:
    """Two images on 400 x 300 pixels, the first on the left of x = 200."""
    first = _tile(PLANKS[: SIZE[1], : SIZE[0]], (0, 0, *SIZE))
    columns, rows = (round(n / label_size) for n in SIZE)
    labels = np.zeros((rows, columns), dtype=np.int32)
    labels[:, columns // 2 :] = 1
    return measure_seams([first, _tile(second, (0, 0, *SIZE))], labels, label_size, unit)


def _shifted(
    right: int, down: int, within: tuple[int, int] = (0, SIZE[1]), scene: Float32Array = PLANKS
) -> Float32Array:
    """A scene, whose rows within a range are shifted."""
    pixels = scene[: SIZE[1], : SIZE[0]].copy()
    top, bottom = within
    pixels[top:bottom] = np.roll(scene, (down, right), (0, 1))[top:bottom, : SIZE[0]]
    return pixels


@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_seams_of_images_that_fit_hold_whatever_their_brightness(gain: float) -> None:
    quality = _quality(gain * _shifted(0, 0) + 10.0)
    assert len(quality.places) > 25
    assert not quality.broken.any()
    assert not quality.broken_at_reference_size


@pytest.mark.parametrize("label_size", [1.0, 2.0, 2.5])
def test_content_that_is_shifted_at_a_seam_is_a_break_with_its_place_and_size(label_size: float) -> None:
    quality = _quality(_shifted(3, 8, (100, 200)), label_size=label_size, unit=4.0)
    longest = quality.breaks[0]
    assert longest.images == (0, 1)
    np.testing.assert_allclose(longest.position, (800.0, 600.0), atol=100.0)
    assert 4.0 * 70.0 < longest.length < 4.0 * 130.0
    assert longest.size == pytest.approx(4.0 * np.hypot(3, 8), abs=4.0)
    assert quality.broken_at_reference_size
    assert not quality.broken[np.abs(quality.places[:, 1] - 600.0) > 4.0 * 70.0].any()


def test_what_a_seam_goes_around_is_no_break() -> None:
    """Something moved ten pixels beside it."""
    pixels = _shifted(0, 0)
    pixels[100:200, 212:300] = _shifted(40, 60)[100:200, 212:300]
    assert not _quality(pixels).broken.any()


def test_an_object_that_is_cut_in_half_is_a_break() -> None:
    """The second image has it; there the first one is empty."""
    scene: Float32Array = np.full((SIZE[1], SIZE[0]), 120.0, dtype=np.float32)
    first, second = scene.copy(), scene.copy()
    second[100:200, 150:250] = np.where(np.indices((100, 100)).sum(axis=0) % 40 < 20, np.float32(40), np.float32(220))
    quality = measure_seams([_tile(image, (0, 0, *SIZE)) for image in (first, second)], LABELS, 1.0, 1.0)
    assert quality.broken_at_reference_size
    assert all(90.0 < y < 210.0 for _, y in quality.places[quality.broken])


def test_what_is_left_of_a_crop_is_counted_from_its_corner() -> None:
    quality = _quality(_shifted(3, 8, (100, 200)))
    part = quality.cropped((150, 80, 300, 300))
    x, y = quality.breaks[0].position
    assert part.breaks[0].position == (x - 150, y - 80)
    assert len(part.places) == int((quality.places[:, 1] >= 80).sum())
    assert quality.cropped((0, 0, 100, 300)).breaks == ()


def test_nothing_is_said_of_images_without_texture_or_without_neighbours() -> None:
    flat: Float32Array = np.zeros((SIZE[1], SIZE[0]), dtype=np.float32)
    assert not len(measure_seams([_tile(flat, (0, 0, *SIZE))] * 2, LABELS, 1.0, 1.0).places)
    assert not measure_seams([_tile(flat, (0, 0, *SIZE)), None], LABELS, 1.0, 1.0).broken_at_reference_size


def test_how_alike_overlaps_look_what_that_fills_and_the_pair_that_does_so_the_least() -> None:
    """A tile elsewhere on the canvas, and one of which a third shows something else."""
    whole = _tile(SCENE[: SIZE[1], : SIZE[0]], (0, 0, *SIZE))
    beside = _tile(SCENE[: SIZE[1], 101:501], (101, 0, 501, 300))
    third = _tile(_shifted(50, 70, (200, 300), SCENE), (0, 0, *SIZE))
    assert likeness([whole, beside, None], np.array([[1, 0], [2, 0]])) == (1.0, 1.0, (0, 1))
    found = likeness([whole, beside, third], np.array([[1, 0], [2, 0]]))
    assert found.alike == pytest.approx((299 + 400 * 2 / 3) / 699, abs=0.06)
    assert found.fills == pytest.approx(1.0 - 400 / 3 / 800, abs=0.06)
    assert found.least_alike == (0, 2)
    nothing = likeness([_tile(0.0 * SCENE[:60, :60], (0, 0, 60, 60))] * 2, np.array([[1, 0]]))
    assert np.isnan(nothing.alike)
    assert nothing.least_alike is None


@pytest.mark.parametrize(
    ("right", "down", "by_chance"), [(0, 0, False), (3, 2, False), (37, 20, True), (-60, 45, True)]
)
def test_images_that_are_put_anywhere_are_alike_by_chance(right: int, down: int, by_chance: bool) -> None:
    tiles = [
        _tile(pixels, (0, 0, *SIZE)) for pixels in (_shifted(0, 0, scene=SCENE), _shifted(right, down, scene=SCENE))
    ]
    quality = SeamQuality(alike=likeness(tiles, np.array([[1, 0]])).alike)
    assert (quality.no_better_than_chance, quality.mostly_unlike) == (by_chance, by_chance)


def test_grass_in_the_wind_is_no_break() -> None:
    """It lies in one direction and is another in each image, but too fine for a seam through it to be seen."""
    rng = np.random.default_rng(4)
    blades = [cv2.GaussianBlur(rng.normal(size=SIZE[::-1]), (0, 0), 2.0, sigmaY=0.6) for _ in range(2)]
    first, second = ((120.0 + 7.0 * one / one.std()).astype(np.float32) for one in blades)
    quality = measure_seams([_tile(image, (0, 0, *SIZE)) for image in (first, second)], LABELS, 1.0, 1.0)
    assert len(quality.places) > 25
    assert quality.broken.sum() <= 1


def _leaves(rng: np.random.Generator) -> Float32Array:
    """Foliage and bare twigs: blobs and strokes of all directions, none longer than 20 pixels."""
    pixels: Float32Array = np.full((500, 600), 150.0, dtype=np.float32)
    for x, y, turn, level in zip(*rng.uniform((0, 0, 0, 40), (600, 500, np.pi, 240), (6000, 4)).T, strict=True):
        half = 8.0 * np.array([np.cos(turn), np.sin(turn)])
        start, end = (np.rint((x, y) + sign * half).astype(int).tolist() for sign in (-1, 1))
        cv2.line(pixels, start, end, level, int(rng.integers(1, 4)), cv2.LINE_AA)
    return cv2.GaussianBlur(pixels, (0, 0), 1.0).astype(np.float32)


@pytest.mark.parametrize("moved", [False, True])
def test_twigs_and_pebbles_that_do_not_fit_are_no_break(moved: bool) -> None:
    """A wind has turned them, or they are nearer than what is behind them; no line ends that somebody would follow."""
    rng = np.random.default_rng(5)
    first = _leaves(rng)
    second = np.roll(first, (9, 4), (0, 1)) if moved else _leaves(rng)
    tiles = [_tile(image[: SIZE[1], : SIZE[0]], (0, 0, *SIZE)) for image in (first, second)]
    quality = measure_seams(tiles, LABELS, 1.0, 1.0)
    assert len(quality.places) > 25
    assert not quality.seams_fit  # it speaks against a layout all the same
    assert not quality.broken_at_reference_size


def test_a_small_output_hides_what_a_large_one_shows() -> None:
    breaks = (SeamBreak((0, 1), (0.0, 0.0), 64.0, 4.0),)
    shown = SeamQuality(np.zeros((20, 2)), broken=np.arange(20) < 8, breaks=breaks, spacing=8.0)
    tenth = replace(shown, breaks=(SeamBreak((0, 1), (0.0, 0.0), 6.4, 0.4),), spacing=0.8)
    assert shown.broken_in_output
    assert tenth.broken_at_reference_size
    assert not tenth.broken_in_output
