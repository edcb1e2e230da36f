"""Composites of rendered sets: exposure, seams, blending, crop, files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from examples.judging.comparison import sharpness
from examples.worlds.compositing_scenes import (
    Scene,
    as_image,
    gradient,
    grey,
    inner,
    loader,
    place_images,
    render,
    side_by_side,
)
from rdstitch.compositing import CompositeOptions, compose, compose_to_file
from rdstitch.compositing.cropping import largest_rectangle
from rdstitch.compositing.preparation import decide, planned, prepare_composite
from rdstitch.compositing.source_images import ImageLoader
from rdstitch.errors import ArgumentError, InputError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.source import Source
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import read_image
from rdstitch.synthetic.rendering import Photometry
from tests.sampled import sampled


def _seams(scene: Scene, options: CompositeOptions) -> NDArray[np.bool_]:
    """Px within two of a seam."""
    with prepare_composite(decide(scene.images, scene.canvas, options)) as ready:
        seams = ready.renderer.seams
    box = (0, 0, *scene.canvas.size)
    shares = np.stack([seams.weights(k, box) for k in range(len(scene.frames))])
    owner = np.where(shares.max(axis=0) > 0, shares.argmax(axis=0), -1)
    edges = np.zeros(owner.shape, np.uint8)
    edges[:, 1:] |= owner[:, 1:] != owner[:, :-1]
    edges[1:] |= owner[1:] != owner[:-1]
    return cv2.dilate(edges, np.ones((5, 5), np.uint8)) > 0


@pytest.mark.parametrize(
    ("exposure", "gamma", "seed"),
    sampled([("blocks", 2.2, 1), ("gain", 1.0, 0), ("balanced", 2.2, 1), ("balanced", 1.0, 0)], 2),
)
def test_unequal_light_leaves_no_visible_seam(gamma: float, seed: int, exposure: str) -> None:
    rng = np.random.default_rng(seed)
    gains = rng.uniform(0.7, 1.3, 9)
    photometry = Photometry(gain=gains, vignetting=0.4, gamma=gamma, noise=0.004)
    scene = render(3, 3, size=(360, 270), photometry=photometry, seed=seed)
    options = CompositeOptions(exposure=exposure)  # type: ignore[arg-type]
    result = scene.composed(exposure=exposure)
    ok, truth, mine = inner(result.alpha), scene.truth(), grey(result.pixels)
    slope = np.polyfit(truth[ok].astype(float), mine[ok].astype(float), 1)[0]
    seam = _seams(scene, options) & ok
    ratio = [
        gradient(mine / np.float32(slope))[where].mean() / gradient(truth)[where].mean() for where in (seam, ok & ~seam)
    ]
    assert ratio[0] / ratio[1] == pytest.approx(1.0, abs=0.05)
    # Light is even over the whole plane: what is left of gain and vignetting after a wide blur of what is covered.
    own, true = (cv2.GaussianBlur(np.where(ok, values, np.float32(0.0)), (0, 0), 12)[ok] for values in (mine, truth))
    light = own / true
    assert light.std() / light.mean() < 0.025
    assert sharpness(mine, truth, ok) > 0.95
    estimated = result.exposure.log_gain.mean(axis=1)
    assert np.std(estimated - np.log(gains) / gamma) < 0.03


# A strip that gets darker from image to image, as automatic exposure leaves it over ground that gets brighter.
DRIFT = np.exp(np.linspace(0.8, -0.8, 6) / 2.2)


def _white(pixels: NDArray[Any]) -> float:
    return float((pixels.max(axis=-1) == 255).mean())


def test_brightness_stays_near_that_of_the_images() -> None:
    """Ground that gets brighter from left to right, and a camera whose automatic exposure makes up for that."""
    scene = render(6, 1, size=(300, 220), seed=6)
    v, u = np.mgrid[:220, :300]
    frames = []
    for k, frame in enumerate(scene.frames):
        along = scene.rendering.to_plane(k, np.stack([u, v], axis=-1))[..., 0] - scene.rendering.poses.position[k, 0]
        brighter = np.exp(1.6 * along / scene.rendering.texture.size[0])[..., None]
        frames.append(np.clip(np.rint(frame * brighter), 0, 255).astype(np.uint8))
    white, middle, rise = {}, {}, {}
    for choice in ("gain", "balanced"):
        result = scene.composed(frames, exposure=choice)
        lit = result.pixels[result.alpha > 0]
        white[choice], middle[choice] = _white(lit), float(np.median(lit))
        ends = [result.pixels[60:-60, part].mean() for part in (np.s_[40:140], np.s_[-140:-40])]
        rise[choice] = float(np.log(ends[1] / ends[0]))
    inputs = np.concatenate([frame.reshape(-1, 3) for frame in frames])
    assert white["gain"] > _white(inputs) + 0.02
    assert white["balanced"] <= _white(inputs) + 0.005
    assert rise["balanced"] < 0.7 * rise["gain"]
    assert middle["balanced"] == pytest.approx(float(np.median(inputs)), rel=0.07)


def test_brightness_that_drifts_over_an_even_wall_is_evened_out() -> None:
    scene = render(6, 1, size=(300, 220), seed=6)
    grey_wall = [np.full_like(frame, round(110 * gain)) for frame, gain in zip(scene.frames, DRIFT, strict=True)]
    row = {}
    for choice in ("none", "gain", "balanced"):
        result = scene.composed(grey_wall, exposure=choice, blend="none")
        row[choice] = result.pixels[result.pixels.shape[0] // 2, 30:-30, 0].astype(int)
    largest = {choice: np.abs(np.diff(values)).max() for choice, values in row.items()}
    assert largest["none"] > 12
    assert largest["balanced"] <= 2
    assert largest["gain"] <= 2
    own, *even = (np.log(values[0] / values[-1]) for values in row.values())
    assert np.abs(even).max() < 0.1 * own
    assert np.median(row["balanced"]) == pytest.approx(110.0, rel=0.1)


def test_a_clipped_sky_ends_in_no_step() -> None:
    """The brighter image is burnt out where the other is not; beside the seam the two are equally bright."""
    light = Photometry(gain=np.array([1.8, 1.0]), gamma=2.2)
    scene = render(2, 1, size=(320, 240), overlap=0.6, photometry=light, seed=8)
    sky = [frame.copy() for frame in scene.frames]
    sky[0][:100], sky[1][:100] = 255, 240
    steps = {}
    for choice in ("gain", "balanced"):
        result = scene.composed(sky, exposure=choice, blend="none", seam="voronoi")
        row = grey(result.pixels)[60, 40:-40]
        steps[choice] = float(np.abs(np.diff(row)).max())
    assert steps["gain"] > 0.1
    assert steps["balanced"] < 0.4 * steps["gain"]


@pytest.mark.parametrize("share", sampled([0.06, 0.2, 0.4, 0.11, 0.28], 3))
@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_what_only_one_image_shows_colours_nothing(share: float, noise: float) -> None:
    """Two pieces of white paper with text, equally exposed, and a blue header on the second."""
    rng, (width, height, step) = np.random.default_rng(4), (300, 360, 160)
    paper = np.full((height + step, width, 3), 245, np.uint8)
    for x, y, w in rng.integers((10, 10, 4), (width - 30, height + step - 10, 25), (250, 3)):
        paper[y : y + 3, x : x + w] = 20
    frames = [paper[:height].copy(), paper[step:].copy()]
    header = round(share * (height - step))
    frames[1][:header] = 0, 110, 220
    if noise:
        frames = [np.clip(frame + rng.normal(0, noise, frame.shape), 0, 255).astype(np.uint8) for frame in frames]
    result = side_by_side(frames, [(0, 0), (0, step)], blend="none")
    first, second = frames[0], frames[1]
    np.testing.assert_array_equal(result.pixels[:step], first[:step])
    np.testing.assert_array_equal(result.pixels[height : height + step], second[height - step :])
    both = result.pixels[step:height], first[step:], second[: height - step]
    same = [(both[0] == own).all(axis=-1) for own in both[1:]]
    assert (same[0] | same[1]).all()


@pytest.mark.parametrize(("seed", "people"), sampled([(0, 0), (2, 6), (3, 6), (4, 6)], 2))
def test_gains_are_found_among_what_moved(seed: int, people: int) -> None:
    """Patches of other colours, a seventh of each image, hardly change what is found for true gains."""
    rng, gains = np.random.default_rng(9 + seed), np.random.default_rng(seed).uniform(0.7, 1.3, 9)
    light = Photometry(gain=gains, vignetting=0.4, noise=0.004)
    scene = render(3, 3, size=(360, 270), photometry=light, seed=seed)
    frames = [frame.copy() for frame in scene.frames]
    for frame in frames:
        for x, y in rng.integers(0, (310, 210), (people, 2)):
            frame[y : y + 60, x : x + 50] = rng.integers(0, 255, 3)
    exposure = scene.composed(frames, exposure="gain").exposure
    assert np.std(exposure.log_gain.mean(axis=1) - np.log(gains)) < 0.005
    np.testing.assert_allclose(np.exp(exposure.vignetting.sum()), 1 - 0.4, atol=0.05)


@pytest.mark.parametrize("blend", ["none", "feather", "multiband"])
@pytest.mark.parametrize("seam", ["none", "voronoi", "graphcut"])
def test_every_combination_shows_the_plane(blend: str, seam: str) -> None:
    scene = render(3, 2)
    result = scene.composed(blend=blend, seam=seam, exposure="none")
    ok = inner(result.alpha)
    mine, truth = grey(result.pixels), scene.truth()
    assert np.sqrt(np.mean((mine[ok] - truth[ok]) ** 2)) < 0.03
    assert sharpness(mine, truth, ok) > 0.95


@pytest.mark.parametrize("shift", sampled([0, 75, -50, 150, -150, -125, -100, -75, -25, 25, 50, 100, 125], 5))
def test_what_moved_is_taken_from_one_image(shift: int) -> None:
    """A disc that lies elsewhere in each of two images may appear whole, or not at all, but not cut or faded."""
    scene = render(2, 1, size=(640, 480), overlap=0.7, distortion=-0.1, seed=5)
    truth = scene.rendering
    frames = [frame.copy() for frame in scene.frames]
    middle = np.mean([truth.to_plane(i, np.array([[320.0, 240.0]]))[0] for i in (0, 1)], axis=0)
    places = middle + np.array([(shift - 20.0, 90.0), (shift + 25.0, -60.0)])
    for index, place in enumerate(places):
        x, y = truth.to_image(index, place[None])[0]
        cv2.circle(frames[index], (round(float(x)), round(float(y))), 28, (255, 0, 255), -1)
    result = scene.composed(frames, exposure="none")
    pink = (result.pixels[..., 0] > 200) & (result.pixels[..., 1] < 60) & (result.pixels[..., 2] > 200)
    for place in places:
        at = scene.canvas.matrix @ np.append(place, 1.0)
        v, u = np.mgrid[: pink.shape[0], : pink.shape[1]]
        share = pink[np.hypot(u - at[0], v - at[1]) < 22].mean()
        assert share < 0.02 or share > 0.98


def test_crop_keeps_no_hole_and_most_of_the_image() -> None:
    scene = render(3, 2)
    whole, cropped = scene.composed(), scene.composed(crop="auto")
    assert (cropped.alpha == 255).all()
    assert cropped.messages == ()
    assert cropped.alpha.size > 0.7 * (whole.alpha > 0).sum()
    # The crop is a part of the whole, px for px.
    dx, dy = np.round(whole.canvas.matrix[:2, 2] - cropped.canvas.matrix[:2, 2]).astype(int)
    height, width = cropped.alpha.shape
    np.testing.assert_array_equal(whole.pixels[dy : dy + height, dx : dx + width], cropped.pixels)


def test_crop_that_would_keep_little_is_not_done() -> None:
    """Images that meet at their corners only."""
    frames = [np.full((80, 100), 50, np.uint8)] * 6
    result = side_by_side(frames, [(100 * k, 80 * k) for k in range(6)], crop="auto")
    assert result.canvas.size == (600, 480)
    assert "not cropped" in result.messages[0].text


@pytest.mark.parametrize("seed", range(5))
def test_largest_rectangle_against_all_rectangles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.random((9, 11)) < 0.8
    x0, y0, x1, y1 = largest_rectangle(cells)
    assert cells[y0:y1, x0:x1].all()
    areas = [
        (b - a) * (d - c)
        for a in range(11)
        for b in range(a + 1, 12)
        for c in range(9)
        for d in range(c + 1, 10)
        if cells[c:d, a:b].all()
    ]
    assert (x1 - x0) * (y1 - y0) == max(areas)


@pytest.mark.parametrize("suffix", ["tif", "png", "jpg"])
def test_file_is_what_memory_is(tmp_path: Path, suffix: str) -> None:
    scene = render(3, 1)
    result = scene.composed(tile_size=256)
    told: list[float] = []
    known, options = Metadata((1, 1), icc_profile=b"profile" * 30), CompositeOptions(tile_size=256)
    decisions = decide(scene.images, scene.canvas, options)
    compose_to_file(tmp_path / f"a.{suffix}", decisions, told.append, metadata=known)
    back = read_image(tmp_path / f"a.{suffix}")
    assert back.metadata.icc_profile == b"profile" * 30
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
    if suffix == "jpg":
        assert np.abs(back.pixels.astype(int) - result.pixels)[inner(result.alpha)].mean() < 3
    else:
        np.testing.assert_array_equal(back.pixels, result.pixels)
        np.testing.assert_array_equal(back.alpha, result.alpha)
    if suffix == "tif":
        with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
            assert len(tiff.series[0].levels) > 1


def test_sixteen_bits_grey_and_mixed_sizes() -> None:
    scene = render(3, 1, channels=1, photometry=Photometry(bits=16))
    frames = list(scene.frames)
    # One image at half the resolution: the same lens, another size.
    frames[1] = cv2.resize(frames[1], (160, 120), interpolation=cv2.INTER_AREA)
    cameras = [c if k != 1 else c.resized((160, 120)) for k, c in enumerate(scene.cameras)]
    sources = [loader(as_image(frame)) for frame in frames]
    result = compose(place_images(sources, cameras, scene.homographies), scene.canvas, CompositeOptions())
    assert result.pixels.dtype == np.uint16
    assert result.pixels.ndim == 2
    ok = inner(result.alpha)
    assert np.sqrt(np.mean((grey(result.pixels)[ok] - scene.truth()[ok]) ** 2)) < 0.06
    assert len(np.unique(result.pixels)) > 1000


def test_a_mask_on_any_image_is_planned_for() -> None:
    scene = render(2, 1)
    plain, first, last = (
        planned(
            [replace(image, transparent=k == masked) for k, image in enumerate(scene.images)],
            scene.canvas,
            CompositeOptions(),
        )
        for masked in (None, 0, 1)
    )
    assert first.memory_bytes == last.memory_bytes > plain.memory_bytes
    source = Source(Path("a.png"), Metadata((8, 6)), Camera((8, 6)))
    assert not source.may_be_transparent
    assert replace(source, metadata=Metadata((8, 6), channels=4)).may_be_transparent


def test_images_that_do_not_fit_and_wrong_options() -> None:
    options: list[dict[str, Any]] = [{"blend": "soft"}, {"seam": ""}, {"tile_size": 300}, {"bands": 0}]
    for wrong_option in (*options, {"scale": -1.0}, {"background": 300}):
        with pytest.raises(ArgumentError):
            CompositeOptions(**wrong_option)
    scene = render(2, 1)
    wrong: list[ImageLoader] = [scene.sources[0], loader(as_image(np.zeros((10, 10, 3), np.uint8)))]
    with pytest.raises(InputError, match="image 2"):
        compose(place_images(wrong, scene.cameras, scene.homographies), scene.canvas)
    deep: list[ImageLoader] = [scene.sources[0], loader(as_image(np.zeros((240, 320, 3), np.uint16)))]
    with pytest.raises(InputError, match="uint16"):
        compose(place_images(deep, scene.cameras, scene.homographies), scene.canvas)
    with pytest.raises(ArgumentError):
        compose(scene.images[:1], scene.canvas)
