"""Arrays and single paths as input, and what comes back without touching the disk."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import rdstitch
from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.frame import Frame, as_inputs
from rdstitch.io.read import read_image

_OPTIONS = rdstitch.StitchOptions(workers=1, features=rdstitch.FeatureOptions(max_features=600))
_RGB = replace(_OPTIONS, channel_order="rgb")
_DRY = replace(_OPTIONS, dry_run=True)


@pytest.fixture(scope="module")
def arrays(frames: list[Path]) -> list[NDArray[np.uint8]]:
    """The frames as OpenCV reads them; the ground is coloured."""
    return [np.asarray(cv2.imread(str(path)), dtype=np.uint8) for path in frames]


@pytest.fixture(scope="module")
def of_files(frames: list[Path]) -> rdstitch.StitchResult:
    """What comes of the files."""
    return rdstitch.pano(frames, options=_OPTIONS)


def test_arrays_give_what_their_files_give_and_nothing_is_written(
    arrays: list[NDArray[np.uint8]], of_files: rdstitch.StitchResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = rdstitch.pano(arrays, options=_OPTIONS)
    assert list(tmp_path.iterdir()) == []
    assert result.distortion == of_files.distortion
    np.testing.assert_array_equal(result.image, of_files.composite.pixels[..., ::-1])
    np.testing.assert_array_equal(result.alpha, of_files.composite.alpha)
    assert [source.name for source in result.registration.sources] == ["image_0000", "image_0001", "image_0002"]


def test_rgb_arrays_give_an_rgb_image(arrays: list[NDArray[np.uint8]], of_files: rdstitch.StitchResult) -> None:
    result = rdstitch.mosaic((array[..., ::-1] for array in arrays), options=_RGB)
    np.testing.assert_array_equal(result.image, result.composite.pixels)
    means = [
        image[alpha > 0].mean(axis=0)
        for image, alpha in ((result.image, result.alpha), (of_files.image, of_files.alpha))
    ]
    np.testing.assert_allclose(means[0], means[1][::-1], atol=2.0)
    assert np.ptp(means[0]) > 5.0  # or the test would pass with any order


def test_images_of_pillow_are_in_their_own_colours(frames: list[Path], of_files: rdstitch.StitchResult) -> None:
    images = [Image.open(frame) for frame in frames]
    for image, frame in zip(images, frames, strict=True):
        (found,) = as_inputs(image)
        assert isinstance(found, Frame)
        np.testing.assert_array_equal(found.decoded().pixels, read_image(frame).pixels)
    result = rdstitch.pano(images, options=_OPTIONS)
    np.testing.assert_array_equal(result.image, of_files.image)
    sideways = images[0].copy()
    sideways.getexif()[0x0112] = 6
    (turned,) = as_inputs(sideways)
    assert isinstance(turned, Frame)
    assert turned.decoded().pixels.shape[:2] == sideways.size


def test_tensors_are_refused_with_the_remedy() -> None:
    class Tensor:
        """What torch's class looks like from outside."""

    Tensor.__module__ = "torch"
    with pytest.raises(ArgumentError, match=r"image 0: .*tensor of torch; .*permute\(1, 2, 0\).*channel_order=\"rgb\""):
        as_inputs([Tensor()])  # type: ignore[list-item]


def test_bands_beyond_three_go_through_the_same_warp(arrays: list[NDArray[np.uint8]], tmp_path: Path) -> None:
    five = [np.dstack([array, 255 - array[..., :1], array[..., 1:2] // 2]) for array in arrays]
    result = rdstitch.pano(five, tmp_path / "five.tif", _OPTIONS)
    assert result.registration.alignment.used.all()
    plain = rdstitch.compositing.CompositeOptions(exposure="none", seam="none", blend="none")
    again = rdstitch.apply(tmp_path / "five.tif.json", five, composite=plain)
    assert again.image.shape[2] == 5
    inside = again.alpha == 255
    blue, fourth = again.image[..., 0][inside].astype(int), again.image[..., 3][inside].astype(int)
    assert np.abs(blue + fourth - 255).max() <= 1
    (straight,) = rdstitch.undistort(five[0], distortion=-0.2)
    three = rdstitch.undistort(arrays[0], distortion=-0.2)[0]
    np.testing.assert_array_equal(straight[..., :3], three)


def test_a_generator_that_reuses_its_buffer(arrays: list[NDArray[np.uint8]], of_files: rdstitch.StitchResult) -> None:
    def stream() -> Iterator[NDArray[np.uint8]]:
        buffer = np.empty_like(arrays[0])
        for array in arrays:
            buffer[:] = array
            yield buffer

    assert rdstitch.pano(stream(), options=_DRY).distortion == of_files.distortion


def test_arrays_mix_with_paths_and_are_named(
    arrays: list[NDArray[np.uint8]], frames: list[Path], tmp_path: Path
) -> None:
    result = rdstitch.pano([frames[0], arrays[1], str(frames[2])], tmp_path / "mix.png", _OPTIONS)
    assert [source.name for source in result.registration.sources] == [frames[0].name, "image_0001", frames[2].name]
    np.testing.assert_array_equal(result.image[..., ::-1], read_image(tmp_path / "mix.png").pixels)
    again = rdstitch.apply(tmp_path / "mix.png.json", arrays)
    assert again.matched == "order"
    np.testing.assert_array_equal(again.composite.pixels[..., ::-1], result.image)


def test_a_single_path_is_one_input(frames: list[Path], of_files: rdstitch.StitchResult) -> None:
    for single in (str(frames[0].parent), frames[0].parent):
        assert rdstitch.pano(single, options=_DRY).distortion == of_files.distortion
    with pytest.raises(ArgumentError, match="two different images"):
        rdstitch.mosaic(str(frames[0]))
    with pytest.raises(InputError, match=r"no_such\.jpg"):
        rdstitch.mosaic("no_such.jpg")


def test_undistort_takes_and_gives_arrays(arrays: list[NDArray[np.uint8]], frames: list[Path], tmp_path: Path) -> None:
    (straight,) = rdstitch.undistort(arrays[0], distortion=-0.2)
    (file,) = rdstitch.undistort(str(frames[0]), tmp_path, distortion=-0.2)
    np.testing.assert_array_equal(straight, cv2.imread(str(file)))
    (named,) = rdstitch.undistort([arrays[0]], tmp_path, distortion=-0.2)
    assert named.name == "image_0000.png"
    np.testing.assert_array_equal(straight, cv2.imread(str(named)))


def test_the_cache_knows_arrays_by_their_content(arrays: list[NDArray[np.uint8]], tmp_path: Path) -> None:
    options = replace(_DRY, cache=tmp_path)
    first = rdstitch.pano(arrays[:2], options=options)
    kept = sum(len(files) for _, _, files in os.walk(tmp_path))
    assert rdstitch.pano(arrays[:2], options=options).distortion == first.distortion
    assert sum(len(files) for _, _, files in os.walk(tmp_path)) == kept
    assert rdstitch.pano(arrays[1:], options=options).distortion != first.distortion


@pytest.mark.parametrize(
    ("shape", "dtype", "pixels", "alpha"),
    [
        ((4, 5), np.uint8, (4, 5), None),
        ((4, 5, 1), np.uint16, (4, 5), None),
        ((4, 5, 2), np.uint8, (4, 5), (4, 5)),
        ((4, 5, 3), np.float64, (4, 5, 3), None),
        ((4, 5, 4), np.uint8, (4, 5, 3), (4, 5)),
        ((4, 5, 6), np.float32, (4, 5, 6), None),
    ],
)
def test_shapes_and_types(
    shape: tuple[int, ...], dtype: Any, pixels: tuple[int, ...], alpha: tuple[int, ...] | None
) -> None:
    (frame,) = as_inputs(np.zeros(shape, dtype))
    assert isinstance(frame, Frame)
    image = frame.decoded()
    assert image.pixels.shape == pixels
    assert image.pixels.dtype == (np.float32 if dtype is np.float64 else dtype)
    assert (None if image.alpha is None else image.alpha.shape) == alpha
    assert image.metadata.size == (5, 4)
    assert len(as_inputs(np.zeros((3, 4, 5, 3), np.uint8))) == 3


WRONG: list[Any] = [[np.zeros((4, 5), np.int64)], [np.zeros((0, 5), np.uint8)], [np.zeros(5, np.uint8)], [3], 3]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [*((wrong, ".") for wrong in WRONG), ([None, "b.png"], r"image 0 is None, which cv2\.imread returns")],
)
def test_what_is_no_image_is_named(wrong: Any, told: str) -> None:
    with pytest.raises(ArgumentError, match=told):
        rdstitch.pano(wrong)


def test_what_a_notebook_shows(of_files: rdstitch.StitchResult) -> None:
    text = repr(of_files)
    assert len(text) < 120
    assert "3 of 3 images, λ = -0.2" in text
    preview = of_files._repr_png_()
    shown = cv2.imdecode(np.frombuffer(preview, np.uint8), cv2.IMREAD_UNCHANGED)
    assert max(shown.shape[:2]) <= 800
    assert shown.shape[2] == 4
    planned = rdstitch.pano(
        [source.path for source in of_files.registration.sources], options=rdstitch.StitchOptions(dry_run=True)
    )
    assert planned._repr_png_() is None
    with pytest.raises(ArgumentError, match="a dry run makes no image"):
        _ = planned.image
