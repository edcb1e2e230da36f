"""What a composite needs is planned, made in blocks, and its coordinates tabulated."""

import pickle
from collections import Counter
from collections.abc import Generator, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.worlds.compositing_scenes import Scene, grey, render
from rdstitch import Composer
from rdstitch.compositing import PlacedImage, compose_decided, decide
from rdstitch.compositing import plan as planning
from rdstitch.compositing.compositor import compose
from rdstitch.compositing.plan import CompositePlan, default_memory, plan_composite
from rdstitch.compositing.tables import CompositeTables
from rdstitch.compositing.tiles import Block, OutputStrip
from rdstitch.compositing.transparency import OPACITY_BYTES
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.io.read import DecodedImage
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.apply_sidecar import apply
from rdstitch.pipeline.recipes import pano
from rdstitch.synthetic.rendering import Photometry
from rdstitch.system.cache import Cache, Stored


def _planned(max_memory: int | None = None, *, masked: bool = False) -> CompositePlan:
    scene = render(3, 1)
    options = CompositeOptions(workers=2, max_memory=max_memory)
    return plan_composite(scene.cameras, scene.canvas, options, masked=masked)


@pytest.mark.parametrize(("available", "taken"), [(0, 400 * 2**20), (10**9, 400 * 2**20), (8 * 10**9, 2 * 10**9)])
def test_a_quarter_of_what_is_available_is_taken(available: int, taken: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "available_memory", lambda: available)
    assert default_memory() == taken
    plan = _planned()
    assert (plan.tile_size, plan.workers) == (512, 2)
    assert plan.memory_bytes <= taken
    assert plan.memory_bytes - len(render(3, 1).cameras) * 10**6 <= taken < plan.cache_bytes + plan.memory_bytes
    assert _planned(40 * 2**20).cache_bytes < plan.cache_bytes


def test_less_memory_means_smaller_tiles_on_fewer_threads() -> None:
    plenty, tight = _planned(), _planned(40 * 2**20)
    assert tight.tile_size * tight.workers < plenty.tile_size * plenty.workers
    assert tight.memory_bytes <= 40 * 2**20 < plenty.memory_bytes + plenty.cache_bytes
    with pytest.raises(LimitError, match="raise --max-memory"):
        _planned(2**20)


def test_images_with_transparent_parts_take_more() -> None:
    plain, masked = (_planned(masked=some) for some in (False, True))
    width, height = render(3, 1).cameras[0].image_size
    # Two while one is prepared, and all three in the cache.
    assert masked.memory_bytes - plain.memory_bytes == (2 + 3) * OPACITY_BYTES * width * height


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Larger than one block of four tiles of 256 pixels a side."""
    gains = np.linspace(0.8, 1.2, 9)
    return render(9, 1, size=(240, 180), photometry=Photometry(gain=gains, vignetting=0.3, noise=0.01), seed=8)


@pytest.mark.parametrize(
    ("blend", "seam", "crop"),
    [("multiband", "graphcut", "auto"), ("feather", "voronoi", "none"), ("feather", "none", "none")],
)
def test_blocks_give_the_same_bytes(scene: Scene, tmp_path: Path, blend: Any, seam: Any, crop: Any) -> None:
    options = CompositeOptions(blend=blend, seam=seam, crop=crop, tile_size=256)
    store, computed, images = Cache.at(tmp_path), [], []

    def elsewhere(blocks: Iterable[Block]) -> Generator[list[Stored[OutputStrip]]]:
        for block in blocks:
            # As a worker in another process has it.
            copy = pickle.loads(pickle.dumps(block))
            computed.append(copy.tiles.box)
            images.append(copy.images)
            yield copy.compute(store)

    here = compose(scene.images, scene.canvas, options)
    shares: list[float] = []
    there = compose_decided(decide(scene.images, scene.canvas, options), shares.append, elsewhere)
    assert len(computed) > 1
    assert min(map(len, images)) < len(scene.frames)
    np.testing.assert_array_equal(there.pixels, here.pixels)
    np.testing.assert_array_equal(there.alpha, here.alpha)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    assert not any(file.is_file() for file in tmp_path.rglob("*")), "strips are removed when they were taken"


@pytest.mark.parametrize(("columns", "rows"), [(12, 1), (3, 24)])
def test_no_image_is_read_for_more_than_two_blocks(columns: int, rows: int, tmp_path: Path) -> None:
    """Once for exposure and seams besides, however little memory a worker has."""
    scene, read, blocks = render(columns, rows, size=(160, 120), scale=0.75), Counter[int](), 0

    def counted(index: int, placed: PlacedImage) -> PlacedImage:
        def load(reduction: int) -> DecodedImage:
            read[index] += 1
            return placed.read(reduction)

        return replace(placed, read=load)

    def elsewhere(tasks: Iterable[Block]) -> Generator[list[Stored[OutputStrip]]]:
        for block in tasks:
            nonlocal blocks
            blocks += 1
            # Room for one image.
            renderer = replace(
                block.tiles.renderer, images=block.tiles.renderer.images.part(range(len(block.images)), 1)
            )
            yield replace(block, tiles=replace(block.tiles, renderer=renderer)).compute(Cache.at(tmp_path))

    images = [counted(index, placed) for index, placed in enumerate(scene.images)]
    options = CompositeOptions(tile_size=256, bands=2, workers=2)
    compose_decided(decide(images, scene.canvas, options), elsewhere=elsewhere)
    assert blocks > 2
    assert max(read.values()) <= 1 + 2


FEATHERED = CompositeOptions(blend="feather", exposure="gain")


@pytest.fixture(scope="module")
def six() -> Scene:
    return render(3, 2, photometry=Photometry(gain=np.array([1.0, 0.8, 1.2, 0.9, 1.1, 1.0])))


def test_the_same_image_as_the_compositor_makes(six: Scene) -> None:
    whole = compose(six.images, six.canvas, FEATHERED)
    tables = CompositeTables.of(six.images, six.canvas, FEATHERED)
    found = tables.compose(six.frames)
    assert found.dtype == np.uint8
    assert found.shape == whole.pixels.shape
    np.testing.assert_array_equal(tables.alpha, whole.alpha)
    difference = np.abs(found.astype(float) - whole.pixels)[tables.alpha > 0]
    assert np.percentile(difference, 99.9) <= 2.0  # coordinates in fixed point, and one rounding less


def test_other_images_from_the_same_places_lie_where_they_belong(six: Scene) -> None:
    tables = CompositeTables.of(six.images, six.canvas, FEATHERED)
    other = render(3, 2, channels=1, seed=0)
    found = tables.compose([frame.astype(np.uint16) * 257 for frame in other.frames])
    assert found.dtype == np.uint16
    assert found.shape == tables.alpha.shape
    whole = compose(other.images, other.canvas, CompositeOptions(blend="none", exposure="none"))
    error = np.abs(grey(found) - grey(whole.pixels))[(tables.alpha > 0) & (whole.alpha > 0)]
    assert np.percentile(error, 95) < 0.03


def test_smaller_outputs_are_smoothed() -> None:
    six = render(2, 1, scale=0.2)
    tables = CompositeTables.of(six.images, six.canvas, FEATHERED)
    error = np.abs(grey(tables.compose(six.frames)) - six.truth())[tables.alpha > 0]
    assert np.median(error) < 0.02


def test_sides_too_long_for_one_resampling_are_refused(six: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rdstitch.compositing.tables.TOO_LONG", six.canvas.size[0])
    with pytest.raises(LimitError, match=f"below {six.canvas.size[0]} pixels"):
        CompositeTables.of(six.images, six.canvas, FEATHERED)


def test_what_does_not_fit_is_refused(six: Scene) -> None:
    tables = CompositeTables.of(six.images, six.canvas, FEATHERED)
    with pytest.raises(ArgumentError, match="expected 6 images, not 5"):
        tables.compose(six.frames[1:])
    with pytest.raises(ArgumentError, match="image 2 is of shape"):
        tables.compose([six.frames[0], six.frames[1][:-1], *six.frames[2:]])
    with pytest.raises(ArgumentError, match="image 1 has"):
        tables.compose([frame.astype(np.int32) for frame in six.frames])


@pytest.mark.parametrize("grey", [False, True])
def test_a_composer_takes_images_with_alpha_as_the_result_does(grey: bool) -> None:
    frames = [frame[..., 0] if grey else frame for frame in render(2, 1, seed=4).frames]
    frames[1] = (frames[1] * 0.6).astype(np.uint8)
    clear = [np.dstack([frame, np.full(frame.shape[:2], 255, np.uint8)]) for frame in frames]
    result = pano(clear, options=StitchOptions(composite=CompositeOptions(exposure="gain")))
    composer = Composer(result)
    found = composer.compose(clear)
    np.testing.assert_array_equal(found, composer.compose(frames))
    assert found.shape == result.image.shape
    assert np.abs(found.astype(float) - result.image)[composer.alpha > 0].mean() < 3.0


def test_a_composer_by_a_result_and_by_its_sidecar(tmp_path: Path) -> None:
    six = render(2, 1, seed=4)
    images = [np.ascontiguousarray(frame[..., ::-1]) for frame in six.frames]
    options = StitchOptions(composite=CompositeOptions(exposure="none", crop="auto"))
    result = pano(images, tmp_path / "pano.png", options)
    first = Composer(result)
    found = first.compose(images)
    assert first.names == ("image_0000", "image_0001")
    assert found.shape == result.image.shape
    assert np.abs(found.astype(float) - result.image)[first.alpha > 0].mean() < 3.0
    with pytest.raises(ArgumentError, match="uint8, uint16 or float32"):
        first.compose([image.astype(np.float64) for image in images])
    dry = apply(tmp_path / "pano.png.json", images, dry_run=True)
    with pytest.raises(ArgumentError, match="a dry run makes no image"):
        _ = dry.image
    again = Composer(dry)
    # The whole canvas, where the sidecar's one was cropped.
    assert again.compose(images).shape[2] == 3
    assert again.alpha.size >= first.alpha.size
