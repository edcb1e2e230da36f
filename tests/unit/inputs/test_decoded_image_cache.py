"""Images between stages: decoded once where there is room, and the same whether there is or not."""

import pickle
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ExifTags, Image

from rdstitch.camera import Camera
from rdstitch.inputs import source as sources
from rdstitch.inputs.decoded_image_cache import DecodedImageCache
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io import Metadata, write_image
from rdstitch.io import read as reading
from rdstitch.io.read import DecodedImage, read_image

SIZE = (1500, 1000)  # halved once for a look at it


@pytest.fixture
def source(tmp_path: Path) -> Source:
    pixels = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
    write_image(tmp_path / "a.jpg", pixels)
    return Source(tmp_path / "a.jpg", Metadata(SIZE), Camera(SIZE))


def test_a_source_can_be_sent_elsewhere(source: Source) -> None:
    kept = replace(source, decoded_images=DecodedImageCache())
    kept.read(keep=True)
    for other in (pickle.loads(pickle.dumps(kept)), deepcopy(kept)):
        assert other == kept
        np.testing.assert_array_equal(other.read().pixels, kept.read().pixels)


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    seen: list[int] = []

    def noted(path: Path, reduction: int, metadata: Metadata) -> DecodedImage:
        seen.append(reduction)
        return read_image(path, reduction, metadata)

    monkeypatch.setattr(sources, "read_image", noted)
    return seen


def _image(values: NDArray[np.uint8]) -> DecodedImage:
    return DecodedImage(values, None, Metadata(values.shape[::-1]))


def test_an_image_is_decoded_once_for_all_stages(source: Source, read: list[int]) -> None:
    shelved = replace(source, decoded_images=DecodedImageCache())
    looks = [shelved.read(reduction, keep=True).pixels for reduction in (2, 4, 8)]
    last = shelved.read(8).pixels
    assert read == [2]
    np.testing.assert_array_equal(last, looks[2])
    shelved.read(8)
    assert read == [2, 2]


def test_what_is_on_the_shelf_changes_no_px(source: Source) -> None:
    shelved = replace(source, decoded_images=DecodedImageCache())
    shelved.read(2, keep=True)
    for reduction in (1, 2, 4, 8):
        with_shelf, without = (s.read(reduction, keep=True).pixels for s in (shelved, source))
        np.testing.assert_array_equal(with_shelf, without)


def test_tags_are_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    pixels = np.random.default_rng(0).integers(0, 256, (9, 16, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.jpg", exif=exif)
    source = read_sources([tmp_path / "a.jpg"], skip_bad=False)[0][0]
    expected = read_image(tmp_path / "a.jpg")
    monkeypatch.setattr(reading, "metadata_of", None)
    image = source.read()
    assert image.metadata is source.metadata
    np.testing.assert_array_equal(image.pixels, expected.pixels)


def test_a_larger_size_is_read_from_the_file(source: Source, read: list[int]) -> None:
    shelved = replace(source, decoded_images=DecodedImageCache())
    shelved.read(2, keep=True)
    assert shelved.read().pixels.shape == (SIZE[1], SIZE[0], 3)
    assert read == [2, 1]


def test_masks_are_kept_apart(source: Source, tmp_path: Path) -> None:
    mask = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    mask[:600] = 0
    write_image(tmp_path / "mask.png", mask)
    shelved = replace(source, decoded_images=DecodedImageCache())
    masked = replace(shelved, mask=tmp_path / "mask.png")
    assert shelved.read(2, keep=True).alpha is None
    alpha = masked.read(4, keep=True).alpha
    np.testing.assert_array_equal(alpha, np.repeat([0, 255], [150, 100])[:, None].repeat(375, axis=1))
    assert shelved.read(2).alpha is None


def test_images_for_which_there_is_no_room_are_not_kept() -> None:
    decoded_images = DecodedImageCache(room=250)
    large, small = (_image(np.zeros((10, n), np.uint8)) for n in (20, 5))
    decoded_images.put("large", large)
    decoded_images.put("other", large)
    decoded_images.put("small", small)
    assert decoded_images.take("other") is None
    assert decoded_images.take("large") is large
    assert decoded_images.take("large") is None
    decoded_images.put("other", large)
    assert decoded_images.take("other") is large
    assert decoded_images.take("small") is small
