"""Images out of the ordinary, and those that see beyond the horizon."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

import rdstitch as library
from rdstitch.camera_files import load_camera
from rdstitch.io.read import read_image
from rdstitch.synthetic import FisheyeLens, ground
from tests.cli.faulty import Make
from tests.cli.running import CACHED, DISTORTION, Run, finished, sidecar_of, start


def _saved(suffix: str, change: Callable[[Image.Image], Image.Image] = Image.Image.copy, exif: Any = ()) -> Make:
    """Saves an image that was changed, with tags."""

    def make(good: Path, folder: Path) -> Path:
        tags = Image.Exif()
        tags.update(exif)
        with Image.open(good) as image:
            change(image).save(folder / f"odd{suffix}", exif=tags)
        return folder / f"odd{suffix}"

    return make


def _transparent(image: Image.Image) -> Image.Image:
    image.putalpha(Image.fromarray(np.where(np.indices((300, 400))[0] < 20, 0, 255).astype(np.uint8)))
    return image


def _with_a_hole(good: Path, folder: Path) -> Path:
    """Floating-point samples, some of them NaN."""
    for name in "ab":
        samples = read_image(folder / f"{name}.png").pixels.astype(np.float32) / 255.0
        samples[:30, :50] = np.nan
        tifffile.imwrite(folder / f"{name}.tif", samples, photometric="rgb")
    (folder / "a.tif").rename(folder / "a.png")
    return folder / "b.tif"


def _sixteen_bit(good: Path, folder: Path) -> Path:
    for name in "ab":
        deep = read_image(folder / f"{name}.png").pixels.astype(np.uint16) * 257
        assert cv2.imwrite(str(folder / f"{name}.png"), deep[..., ::-1])
    return folder / "b.png"


ODD: dict[str, Make] = {
    "inks": _saved(".jpg", lambda image: image.convert("CMYK")),
    "palette": _saved(".png", lambda image: image.quantize(200)),
    "transparent": _saved(".png", _transparent),
    "grey": _saved(".png", lambda image: image.convert("L")),
    "turned": _saved(".jpg", lambda image: image.transpose(Image.Transpose.ROTATE_90), {0x0112: 6}),
    "hole": _with_a_hole,
    "16 bits": _sixteen_bit,
    "hostile tags": _saved(".jpg", exif={0x010F: "\x1b[31m" * 500, 0x8769: {0x920A: (0, 0)}}),
}


@pytest.mark.parametrize("make", ODD.values(), ids=ODD)
def test_unusual_images_are_stitched(rdstitch: Run, place: Path, make: Make) -> None:
    odd = make(place / "b.png", place)
    done = rdstitch("pano", place / "a.png", odd, "-o", place / "out.tif", *CACHED, err="")
    assert abs(float(done.out) - DISTORTION) < 0.02
    record = sidecar_of(place / "out.tif")
    assert all(image["used"] for image in record["images"])
    assert [image["size"] for image in record["images"]] == [[400, 300]] * 2


@pytest.mark.parametrize(
    "name",
    [
        "two\nlines.png",
        os.fsdecode(b"caf\xe9.png"),
        "-o.png",
        "[1]*.png",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("a b.png", "it's.png", 'say "x".png', "π.png")),
    ],
)
def test_odd_names_work(place: Path, name: str) -> None:
    image, output = place / name, place / f"out {name}"
    (place / "b.png").rename(image)
    done = finished(start("pano", place / "a.png", image, "-o", output, *CACHED))
    assert (done.status, done.err) == (0, "")
    assert output.exists()
    assert len(sidecar_of(output)["images"]) == 2


def test_what_nobody_here_can_read_is_named(rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("pillow_heif", "rawpy"):
        monkeypatch.setitem(sys.modules, package, None)
    for name in ("new.HEIC", "other.dng", "a.dng"):
        (place / name).write_bytes(b"raw")
    # One that is no sidecar lies beside an image, too.
    (place / "a.png.json").write_text("[" * 100_000, encoding="utf-8")
    monkeypatch.chdir(place.parent)
    lines = sorted(rdstitch("mosaic", place.name, "-o", place / "out.tif", *CACHED).err.splitlines())
    # That of a raw file that has its JPEG beside it goes without saying.
    assert [line.split(":")[2].strip().rpartition("/")[2] for line in lines] == ["new.HEIC", "other.dng"]
    assert all("convert it to JPEG or TIFF" in line for line in lines)
    rdstitch("pano", place / "a.png", place / "other.dng", "-o", place / "new.png", *CACHED, status=3)


SIZE = (400, 300)
LENS = FisheyeLens(SIZE, 105.0, offset=(4.0, -3.0))  # 90 degrees off the axis at 165 pixels
PLACES = ((0.0, 0.0, 0.0), (90.0, 15.0, 0.2), (180.0, -10.0, -0.3))  # x, y, and turned by
HEIGHT = 110.0
FILE = """%YAML:1.0
---
image_width: 400
image_height: 300
fisheye_model: 1
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 105., 0., 203.5, 0., 105., 146.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 0., 0., 0., 0. ]
"""


def _ground_points(points: np.ndarray, place: tuple[float, float, float]) -> np.ndarray:
    """Texels (N, 2) of the ground at measured pixels (N, 2) of an image; NaN beyond the horizon."""
    x, y, turn = place
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    rays = (LENS.undistort(points) - LENS.center) / LENS.focal
    seen: np.ndarray = HEIGHT * rays @ rotation.T + (600.0 + x, 600.0 + y)
    return seen


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("fisheye")
    texture = np.asarray(ground((1400, 1200), 3, 1).region(0, 0, 1400, 1200), dtype=np.float32).reshape(1200, 1400)
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=np.float64), np.arange(SIZE[1], dtype=np.float64))
    for number, place in enumerate(PLACES):
        seen = np.nan_to_num(_ground_points(np.column_stack([u.ravel(), v.ravel()]), place), nan=-1.0)
        x, y = seen.reshape(*u.shape, 2).astype(np.float32).transpose(2, 0, 1)
        image = cv2.remap(texture * 255.0, x, y, cv2.INTER_LINEAR, borderValue=(90.0,))
        cv2.imwrite(str(made / f"{number}.png"), image.astype(np.uint8))
    (made / "fisheye.yml").write_text(FILE, encoding="utf-8")
    return made


@pytest.mark.parametrize("view", ["same", "all", "valid"])
def test_undistorted_images_are_masked(rdstitch: Run, folder: Path, tmp_path: Path, view: str) -> None:
    lens = ("--camera", folder / "fisheye.yml")
    rdstitch("undistort", folder / "0.png", "-o", tmp_path, *lens, "--view", view)
    image = cv2.imread(str(tmp_path / "0.png"), cv2.IMREAD_UNCHANGED)
    if view == "all":
        assert (image[[0, 0, -1, -1], [0, -1, 0, -1], 3] == 0).all()
        # A circle fills this share of its square.
        assert image[..., 3].mean() / 255.0 == pytest.approx(np.pi / 4.0, abs=0.05)
    else:
        assert (image[..., -1] > 0).all()


def test_a_mosaic_of_what_is_before_the_camera(rdstitch: Run, folder: Path, tmp_path: Path) -> None:
    images = [folder / f"{number}.png" for number in range(3)]
    lens = ("--camera", folder / "fisheye.yml")
    rdstitch("pano", *images, "-o", tmp_path / "a.png", *lens, *CACHED)
    image = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert (image[[0, 0, -1, -1], [0, -1, 0, -1], 3] == 0).all()
    options = library.StitchOptions(camera=load_camera(folder / "fisheye.yml"))
    found = library.pano(images, options=options).registration.alignment
    assert found.used.all()
    points = np.random.default_rng(1).uniform((60, 20), (340, 280), (300, 2))
    moved = found.transfer(0, 2, points)
    back = np.linalg.norm(moved - LENS.center, axis=1) < np.radians(65.0) * 105.0
    off = _ground_points(moved[back], PLACES[2]) - _ground_points(points[back], PLACES[0])
    assert back.sum() > 50
    assert np.median(np.linalg.norm(off, axis=1)) < 0.5
