"""Options of compositing on the command line, for real: layers too."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import ExifTags, Image
from rdstitch_cli.main import cli

from rdstitch.io.deepzoom import read_deep_zoom
from rdstitch.io.read import read_image
from tests.cli.running import CACHED, Run, sidecar_of


@pytest.fixture
def sidecar(stitched: Path) -> Path:
    return stitched.with_name("field.tif.json")


WAYS: list[tuple[str, ...]] = [
    ("--exposure", "none", "--seam", "none", "--blend", "none"),
    ("--exposure", "gain", "--seam", "voronoi", "--blend", "feather"),
    ("--exposure", "blocks", "--seam", "graphcut", "--blend", "multiband"),
    ("--interpolation", "linear"),
    ("--interpolation", "lanczos"),
]


def test_every_way_shows_the_same_place(rdstitch: Run, sidecar: Path, frames: list[Path], tmp_path: Path) -> None:
    images = []
    for number, way in enumerate(WAYS):
        output = tmp_path / f"{number}.png"
        done = rdstitch("apply", sidecar, "--images", frames[0].parent, "-o", output, "--scale", "0.5", "-j", "1", *way)
        assert (done.status, done.err) == (0, "")
        used = sidecar_of(output)["options"]["composite"]
        assert {name: used[name.removeprefix("--")] for name in way[::2]} == dict(zip(way[::2], way[1::2], strict=True))
        images.append(read_image(output).pixels.astype(int))
    for number, image in enumerate(images):
        assert np.abs(image - images[0]).mean() < 3
        assert [k for k in range(number) if (images[k] == image).all()] == []


def test_background_is_what_no_image_covers(rdstitch: Run, sidecar: Path, frames: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "white.jpg"
    rdstitch("apply", sidecar, "--images", frames[0].parent, "-o", output, "--background", "255")
    assert (read_image(output).pixels[0, 0] > 250).all()


def test_amounts_of_memory() -> None:
    option = next(option for option in cli.load_all()["pano"].params if option.name == "max_memory")
    amounts = {"800M": 800 * 2**20, "2G": 2**31, "1.5 GiB": 3 * 2**29, "2048k": 2**21, "1234567": 1234567}
    assert {text: option.type.convert(text, None, None) for text in amounts} == amounts


def test_dry_run_reports_and_writes_nothing(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    done = rdstitch("mosaic", *frames, "-o", tmp_path / "a.tif", "--dry-run", *CACHED, err="")
    assert not list(tmp_path.iterdir())
    assert done.made == ""
    distortion, *plan = done.out.splitlines()
    float(distortion)
    told = dict(line.split(": ") for line in plan)
    assert set(told) == {"images", "canvas", "output", "memory", "time"}
    assert told["images"] == "3"
    rdstitch("mosaic", *frames, "-o", tmp_path / "a.png", *CACHED)
    height, width = read_image(tmp_path / "a.png").pixels.shape[:2]
    assert told["canvas"].startswith(f"{width} x {height} pixels")
    before = (tmp_path / "a.png").read_bytes()
    rdstitch("mosaic", *frames, "-o", tmp_path / "a.png", "--dry-run", *CACHED)
    assert (tmp_path / "a.png").read_bytes() == before


def test_deep_zoom_is_the_same_image(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    output, report = tmp_path / "a.dzi", tmp_path / "report.html"
    command = ("mosaic", *frames, "-o", output, "--report", report, *CACHED)
    rdstitch(*command, "--dry-run")
    assert not list(tmp_path.iterdir())
    rdstitch(*command)
    assert {path.name for path in tmp_path.iterdir()} == {"a.dzi", "a_files", "a.dzi.json", "a.html", "report.html"}
    rdstitch("mosaic", *frames, "-o", tmp_path / "a.png", *CACHED)
    whole = read_image(tmp_path / "a.png")
    height, width = whole.alpha.shape
    tiles = read_deep_zoom(output, (width, height), max(width, height)).astype(int)
    sure = cv2.erode(whole.alpha, np.ones((33, 33), np.uint8)) == 255
    assert np.abs(tiles - whole.pixels)[sure].mean() < 0.5 * np.abs(np.roll(tiles, 1, 1) - whole.pixels)[sure].mean()


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_tags_are_kept_and_upright(
    rdstitch: Run, sidecar: Path, frames: list[Path], tmp_path: Path, suffix: str
) -> None:
    profile, folder = bytes(range(256)) * 2, tmp_path / "turned"
    folder.mkdir()
    for frame in frames:
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation], exif[ExifTags.Base.Make] = 6, "Maker"
        with Image.open(frame) as image:
            turned = image.transpose(Image.Transpose.ROTATE_90)
        turned.save(folder / frame.name, exif=exif, icc_profile=profile)
    folders = {"upright": frames[0].parent, "turned": folder}
    for name, images in folders.items():
        rdstitch("apply", sidecar, "--images", images, "-o", tmp_path / f"{name}.{suffix}", "--scale", "0.3")
    upright, turned_output = (read_image(tmp_path / f"{name}.{suffix}") for name in folders)
    np.testing.assert_array_equal(turned_output.pixels, upright.pixels)
    assert (upright.metadata.icc_profile, upright.metadata.make) == (b"", "")
    assert (turned_output.metadata.icc_profile, turned_output.metadata.make) == (profile, "Maker")
    with Image.open(tmp_path / f"turned.{suffix}") as written:
        assert written.getexif().get(ExifTags.Base.Orientation, 1) == 1


def _saved(frames: list[Path], folder: Path, modes: str, **tags: Any) -> list[Path]:
    """Copies, grey where their letter is L, with a profile of such samples."""
    files = [folder / f"{frame.stem}.tif" for frame in frames]
    folder.mkdir()
    for frame, file, mode in zip(frames, files, modes, strict=True):
        profile = bytes(16) + {"L": b"GRAY", "C": b"RGB "}[mode] + bytes(200)
        with Image.open(frame) as image:
            (image.convert("L") if mode == "L" else image).save(file, icc_profile=profile, **tags)
    return files


@pytest.mark.parametrize(("modes", "suffix", "kept"), [("CCC", "png", b"RGB "), ("LCC", "jpg", b"RGB "),
                         ("LLL", "tif", b"GRAY"), ("LLL", "webp", b"")])  # fmt: skip
def test_profile_is_one_of_the_samples_and_in_the_layers_too(
    rdstitch: Run, frames: list[Path], tmp_path: Path, modes: str, suffix: str, kept: bytes
) -> None:
    files, output, layers = _saved(frames, tmp_path / "in", modes), tmp_path / f"out.{suffix}", tmp_path / "layers"
    done = rdstitch("mosaic", tmp_path / "in", "-o", output, "--layers", layers, *CACHED)
    assert ("one of grey samples, and WebP has colours" in done.err) == (suffix == "webp")
    assert ("another colour profile than" in done.err) == (modes == "LCC")
    assert read_image(output).metadata.icc_profile[16:20] == kept
    in_layer = b"GRAY" if modes == "LLL" else b"RGB "
    assert {read_image(layers / file.name).metadata.icc_profile[16:20] for file in files} == {in_layer}
    assert read_image(layers / f"{files[0].stem}_mask.tif").metadata.icc_profile == b""


def test_dots_per_inch_are_scaled(rdstitch: Run, sidecar: Path, frames: list[Path], tmp_path: Path) -> None:
    _saved(frames, tmp_path / "in", "CCC", dpi=(300.0, 300.0))
    output, expected = tmp_path / "out.tif", {("--scale", "0.5"): (150.0, 150.0), ("--max-size", "300"): None}
    for option, dpi in expected.items():
        rdstitch("apply", sidecar, "--images", tmp_path / "in", "-o", output, *option, "--overwrite")
        assert read_image(output).metadata.dpi == dpi


@pytest.mark.parametrize("whole", [False, True])
def test_layers_by_masks_are_the_composite(rdstitch: Run, frames: list[Path], tmp_path: Path, whole: bool) -> None:
    output, folder = tmp_path / "all.png", tmp_path / "layers"
    more = ["--whole-layers"] if whole else []
    rdstitch("mosaic", frames[0].parent, "-o", output, "--blend", "none", "--layers", folder, *more, *CACHED, err="")
    composite = read_image(output)
    joined = np.zeros_like(composite.pixels)
    owners: NDArray[np.int_] = np.zeros(composite.alpha.shape, dtype=np.int_)
    for frame in frames:
        with tifffile.TiffFile(folder / f"{frame.stem}.tif") as file:
            page = file.pages.first
            layer = page.asarray()
            mask = tifffile.imread(folder / f"{frame.stem}_mask.tif")
            x, y = (round(150 * page.tags[tag].value[0] / page.tags[tag].value[1]) for tag in (286, 287))
            assert (page.tags[33300].value, page.tags[33301].value) == owners.shape[::-1]
        height, width = mask.shape
        assert layer.shape == (height, width, composite.pixels.shape[2] + 1 if composite.pixels.ndim == 3 else 2)
        assert ((height, width) == owners.shape) == whole
        assert (layer[..., -1][mask > 0] == 255).all()
        there = np.s_[y : y + height, x : x + width]
        pixels = layer[..., :-1] if composite.pixels.ndim == 3 else layer[..., 0]
        joined[there][mask > 0] = pixels[mask > 0]
        owners[there] += mask > 0
        with Image.open(folder / f"{frame.stem}.tif") as image:
            assert image.size == (width, height)
    np.testing.assert_array_equal(owners, composite.alpha > 0)
    # Seams are found once more, on the same small versions of the images.
    shown = np.where(owners[..., None] > 0, np.atleast_3d(composite.pixels), 0)
    np.testing.assert_array_equal(np.atleast_3d(joined), shown)
