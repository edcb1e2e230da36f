"""Images and names that are unusual, yet usable: stitched like any other."""

import json
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

from rdstitch.io import read_image
from tests.cli.faulty import Make
from tests.cli.running import CACHED, DISTORTION, Run, finished, start


def _saved(good: Path, file: Path, change: Callable[[Image.Image], Image.Image], **options: Any) -> Path:
    with Image.open(good) as image:
        change(image).save(file, **options)
    return file


def _cmyk(good: Path, folder: Path) -> Path:
    return _saved(good, folder / "odd.jpg", lambda image: image.convert("CMYK"))


def _palette(good: Path, folder: Path) -> Path:
    return _saved(good, folder / "odd.png", lambda image: image.quantize(200))


def _transparent(good: Path, folder: Path) -> Path:
    def change(image: Image.Image) -> Image.Image:
        image.putalpha(Image.fromarray(np.where(np.indices((300, 400))[0] < 20, 0, 255).astype(np.uint8)))
        return image

    return _saved(good, folder / "odd.png", change)


def _grey(good: Path, folder: Path) -> Path:
    return _saved(good, folder / "odd.png", lambda image: image.convert("L"))


def _turned(good: Path, folder: Path) -> Path:
    exif = Image.Exif()
    exif[0x0112] = 6
    return _saved(good, folder / "odd.jpg", lambda image: image.transpose(Image.Transpose.ROTATE_90), exif=exif)


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


def _hostile_exif(good: Path, folder: Path) -> Path:
    exif = Image.Exif()
    exif[0x010F] = "\x1b[31m" * 500
    exif[0x8769] = {0x920A: (0, 0)}
    return _saved(good, folder / "odd.jpg", lambda image: image, exif=exif)


@pytest.mark.parametrize(
    "make", [_cmyk, _palette, _transparent, _grey, _turned, _with_a_hole, _sixteen_bit, _hostile_exif]
)
def test_unusual_images_are_stitched(rdstitch: Run, place: Path, make: Make) -> None:
    odd = make(place / "b.png", place)
    done = rdstitch("pano", place / "a.png", odd, "-o", place / "out.tif", *CACHED, err="")
    assert abs(float(done.out) - DISTORTION) < 0.02
    record = json.loads((place / "out.tif.json").read_text(encoding="utf-8"))
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
    record = json.loads(Path(f"{output}.json").read_text(encoding="utf-8"))
    assert len(record["images"]) == 2


def test_images_that_nobody_here_can_read_are_named(
    rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
