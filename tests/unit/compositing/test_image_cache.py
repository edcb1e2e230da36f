"""Images of a composite: decoded, kept, and masked."""

import tempfile
import tracemalloc
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from errno import ENOSPC
from functools import partial
from pathlib import Path
from threading import Event, Timer
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from examples.worlds.compositing_scenes import Scene, as_image, place_images, render
from rdstitch.compositing import CompositeOptions, compose
from rdstitch.compositing.image_cache import ImageCache
from rdstitch.compositing.source_images import ImageOnDisk, ImageReader, LoadedImage, PlacedImage, prepare_image
from rdstitch.compositing.transparency import filled
from rdstitch.errors import InputError
from rdstitch.geometry.camera import Camera
from rdstitch.io.read import DecodedImage, reduced


class DecodedImageCache:
    """Four images, and how often each was read."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.frames = [rng.integers(0, 256, (100, 200), dtype=np.uint8) for _ in range(4)]
        self.reads: Counter[int] = Counter()

    def read(self, index: int, reduction: int) -> DecodedImage:
        self.reads[index] += 1
        return reduced(as_image(self.frames[index]), reduction)

    def cache(self, limit: int, *, ahead: bool = False) -> ImageCache:
        lens = Camera((200, 100))
        read = [lambda reduction, k=k: self.read(k, reduction) for k in range(4)]
        reader = ImageReader(place_images(read, [lens] * 4, [np.eye(3)] * 4))
        assert reader.samples[0] == 1
        self.reads.clear()
        return ImageCache(reader, [1.0] * 4, limit, ahead=ahead)


@pytest.mark.parametrize("disk", ["writable", "missing", "full"])
def test_those_used_last_are_held_and_the_others_wait_on_disk(
    disk: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a disk it takes time, and no more."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing" if disk == "missing" else tmp_path))
    if disk == "full":
        monkeypatch.setattr(ImageOnDisk, "write", Mock(side_effect=OSError(ENOSPC, "No space left on device")))
    writable = disk == "writable"
    decoded_images = DecodedImageCache()
    cache = decoded_images.cache(limit=2 * 20_000)
    for index in (0, 1, 0, 1, 2, 1, 0):
        np.testing.assert_array_equal(cache.get(index).pixels, decoded_images.frames[index])
    assert decoded_images.reads == {0: 1 if writable else 2, 1: 1, 2: 1}
    assert sum(file.stat().st_size for file in tmp_path.rglob("*")) >= 20_000 * writable
    cache.expect({0, 1})
    cache.close()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
def test_what_waits_on_disk_comes_back_as_it_was(kind: str) -> None:
    rng = np.random.default_rng(2)
    frames = [rng.integers(0, 200, (99, 201, 3)).astype(kind) for _ in range(3)]
    alpha = np.where(rng.random((99, 201)) < 0.1, np.uint8(0), np.uint8(255))
    images = [replace(as_image(frame), alpha=alpha) for frame in frames]
    reader = ImageReader(place_images([partial(reduced, p) for p in images], [Camera((201, 99))] * 3, [np.eye(3)] * 3))
    cache, whole = ImageCache(reader, [1.0] * 3, 1), [prepare_image(p, 1.0) for p in images]
    for _ in range(2):
        for index in range(3):
            kept = cache.get(index)
            for got, true in ((kept.pixels, whole[index].pixels), (kept.opacity, whole[index].opacity)):
                assert got is not None
                np.testing.assert_array_equal(got, true)


def test_what_is_not_expected_makes_room_and_is_read_once_more_if_need_be() -> None:
    decoded_images = DecodedImageCache()
    cache = decoded_images.cache(limit=40_000)
    cache.get(0)
    cache.get(1)
    cache.expect({1, 2})
    cache.get(2)
    cache.get(1)
    assert decoded_images.reads == {0: 1, 1: 1, 2: 1}
    np.testing.assert_array_equal(cache.get(0).pixels, decoded_images.frames[0])
    np.testing.assert_array_equal(cache.get(0).pixels, decoded_images.frames[0])
    assert decoded_images.reads == {0: 2, 1: 1, 2: 1}


def test_images_can_be_had_while_another_one_goes_to_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded_images, writing, go_on = DecodedImageCache(), Event(), Event()
    cache = decoded_images.cache(limit=40_000)
    cache.get(0)
    cache.get(1)

    def slow(image: LoadedImage, file: Path) -> ImageOnDisk:
        writing.set()
        assert go_on.wait(30)
        return write(image, file)

    write = ImageOnDisk.write
    monkeypatch.setattr(ImageOnDisk, "write", slow)
    with ThreadPoolExecutor(2) as pool:
        third = pool.submit(cache.get, 2)
        assert writing.wait(30)
        for index in (1, 0):  # 0 is what is being written
            np.testing.assert_array_equal(pool.submit(cache.get, index).result(10).pixels, decoded_images.frames[index])
        go_on.set()
        np.testing.assert_array_equal(third.result(30).pixels, decoded_images.frames[2])
    assert decoded_images.reads == {0: 1, 1: 1, 2: 1}


def wait_for_all_read_ahead(cache: ImageCache) -> None:
    assert cache._ahead is not None
    cache._ahead.submit(int).result()


def test_images_are_read_ahead_where_there_is_room() -> None:
    decoded_images = DecodedImageCache()
    cache = decoded_images.cache(limit=45_000, ahead=True)
    cache.expect({0, 1, 2})
    cache.prefetch([3, 1, 0, 2, 1])
    wait_for_all_read_ahead(cache)
    assert decoded_images.reads == {0: 1, 1: 1}
    np.testing.assert_array_equal(cache.get(0).pixels, decoded_images.frames[0])
    np.testing.assert_array_equal(cache.get(1).pixels, decoded_images.frames[1])
    assert decoded_images.reads == {0: 1, 1: 1}
    cache.expect({1, 2})
    cache.prefetch([2])
    wait_for_all_read_ahead(cache)
    assert decoded_images.reads[2] == 1
    np.testing.assert_array_equal(cache.get(2).pixels, decoded_images.frames[2])
    assert decoded_images.reads == {0: 1, 1: 1, 2: 1}


def test_nothing_is_read_ahead_once_it_is_closed() -> None:
    decoded_images = DecodedImageCache()
    cache = decoded_images.cache(limit=80_000, ahead=True)
    reading, go_on = Event(), Event()

    def slow(index: int, reduction: int) -> DecodedImage:
        reading.set()
        assert go_on.wait(30)
        return DecodedImageCache.read(decoded_images, index, reduction)

    decoded_images.read = slow  # type: ignore[method-assign]
    cache.prefetch(range(4))
    assert reading.wait(30)
    Timer(0.05, go_on.set).start()
    cache.close()
    cache.prefetch(range(4))
    assert decoded_images.reads == {0: 1}
    np.testing.assert_array_equal(cache.get(3).pixels, decoded_images.frames[3])


@pytest.mark.parametrize("shrink", [1.0, 3.9, 5.0])
@pytest.mark.parametrize("masked", [False, True])
def test_the_room_for_an_image_is_known_before(shrink: float, masked: bool) -> None:
    image = as_image(np.zeros((300, 400), dtype=np.uint8))
    if masked:
        image = replace(image, alpha=np.eye(300, 400, dtype=np.uint8) * 255)
    reader = ImageReader([PlacedImage(partial(reduced, image), Camera((400, 300)), np.eye(3))])
    assert reader.masked(0) is masked
    assert reader.nbytes(0, shrink) >= reader.prepared(0, shrink).nbytes


def test_a_grey_image_before_coloured_ones_gets_colours() -> None:
    grey, coloured = (as_image(np.full((3, 4, *bands), 7, dtype=np.uint8)) for bands in ((), (3,)))
    images = [
        PlacedImage(partial(reduced, image), Camera((4, 3)), np.eye(3), coloured=image is coloured)
        for image in (grey, coloured)
    ]
    for reader in (ImageReader(images), ImageReader(images).part([0])):
        assert reader.samples[0] == 3
        np.testing.assert_array_equal(reader(0).pixels, coloured.pixels)
    assert ImageReader(images[:1]).samples[0] == 1


def test_an_image_of_another_size_is_named_by_its_file() -> None:
    wrong = PlacedImage(partial(reduced, as_image(np.zeros((30, 41), np.uint8))), Camera((40, 30)), np.eye(3))
    images = [wrong, wrong, replace(wrong, path="/a/bad.jpg")]
    with pytest.raises(InputError, match=r"^/a/bad\.jpg: has 41 x 30 pixels, but its camera has 40 x 30$"):
        ImageReader(images).part([2])(0)
    with pytest.raises(InputError, match=r"^image 2: has 41 x 30 pixels"):
        ImageReader(images)(1)


def test_a_failed_prefetch_raises_where_the_image_is_read() -> None:
    decoded_images = DecodedImageCache()
    cache = decoded_images.cache(limit=80_000, ahead=True)
    decoded_images.frames[1] = decoded_images.frames[1][:50]
    cache.prefetch([1, 2])
    wait_for_all_read_ahead(cache)
    assert decoded_images.reads[2] == 1
    with pytest.raises(InputError, match="image 2: has 200 x 50 pixels"):
        cache.get(1)


def _counted(scene: Scene, decoded: Counter[int], *, masked: bool) -> list[PlacedImage]:
    """The images of a scene; of masked ones a disc and a strip are transparent."""
    images = []
    for index, (frame, placed) in enumerate(zip(scene.frames, scene.images, strict=True)):
        alpha = np.full(frame.shape[:2], 255, dtype=np.uint8)
        cv2.circle(alpha, (80, 60 + 7 * index), 30, 0, -1)
        alpha[:20] = 0
        image = as_image(frame, alpha if masked and index % 3 else None)

        def read(reduction: int, index: int = index, image: DecodedImage = image) -> DecodedImage:
            decoded[index] += reduction == 1
            return reduced(image, reduction)

        images.append(replace(placed, read=read))
    return images


@pytest.mark.parametrize(
    ("options", "masked"),
    [
        ({}, True),
        ({"seam": "voronoi", "blend": "feather"}, False),
        ({"seam": "none"}, True),
        ({"seam": "none", "blend": "none", "exposure": "none"}, False),
        ({"scale": 0.4, "workers": 2}, True),
    ],
    ids=str,
)
def test_whatever_the_memory(options: dict[str, Any], masked: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = render(3, 2, size=(240, 180), rotate=37.0, scale=options.get("scale", 1.2))
    chosen = CompositeOptions(tile_size=256, bands=4, **({"workers": 1} | options | {"scale": 1.0}))
    # Exposure and seams are decided on small images, which are not read smaller from images as small as these.
    most = 1 if options.get("exposure") == "none" else 2
    decoded: Counter[int] = Counter()
    plenty = compose(_counted(scene, decoded, masked=masked), scene.canvas, chosen)
    assert max(decoded.values()) <= most
    decoded.clear()

    # The least that the plan allows: room for one image.
    def tight(reader: ImageReader, shrinks: Sequence[float], limit: int, *, ahead: bool) -> ImageCache:
        return ImageCache(reader, shrinks, 1, ahead=ahead)

    monkeypatch.setattr("rdstitch.compositing.preparation.ImageCache", tight)
    little = compose(_counted(scene, decoded, masked=masked), scene.canvas, chosen)
    assert max(decoded.values()) <= most
    np.testing.assert_array_equal(little.pixels, plenty.pixels)
    np.testing.assert_array_equal(little.alpha, plenty.alpha)


def test_what_is_transparent_has_the_samples_of_the_nearest_opaque_pixel() -> None:
    rng = np.random.default_rng(0)
    height, width = 60, 80
    opaque = np.ones((height, width), dtype=np.bool_)
    opaque[:, 55:] = False
    opaque[10:25, 10:30] = rng.random((15, 20)) > 0.7
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([x, y, np.zeros_like(x)], axis=-1).astype(np.uint8)
    made = filled(pixels, opaque)
    assert np.array_equal(made[opaque], pixels[opaque])
    hidden, source = np.argwhere(~opaque), made[~opaque][:, 1::-1].astype(np.intp)
    assert opaque[tuple(source.T)].all()
    nearest = np.asarray(KDTree(np.argwhere(opaque)).query(hidden)[0])
    assert (np.linalg.norm(source - hidden, axis=1) <= 1.05 * nearest).all()  # distances of 5 x 5 chamfers


def test_where_nothing_is_opaque_there_is_nothing_to_fill_with() -> None:
    pixels = np.full((600, 20, 3), 7, dtype=np.uint8)
    assert np.array_equal(filled(pixels, np.zeros((600, 20), dtype=np.bool_)), pixels)


def test_memory_beyond_the_result_is_that_of_some_rows() -> None:
    opaque = np.zeros((3000, 1000), dtype=np.bool_)
    opaque[1500:] = True
    pixels = np.zeros((*opaque.shape, 3), dtype=np.uint8)
    tracemalloc.start()
    made = filled(pixels, opaque)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2.5 * made.nbytes
