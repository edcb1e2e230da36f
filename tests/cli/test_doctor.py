"""``rdstitch doctor``: what it says of sets with known faults."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from rdstitch.errors import LimitError
from rdstitch.pipeline import doctor
from rdstitch.pipeline.doctor import examine
from tests.cli.running import Run, copied


def test_nothing_is_amiss(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    done = rdstitch("doctor", frames[0].parent, err="")
    assert "images:     3\n" in done.out
    assert "400 x 300 (3)" in done.out
    assert "every image has a place" in done.out
    assert "none: go ahead" in done.out
    found = json.loads(rdstitch("doctor", *frames, "--json").out)
    assert found["images"] == 3
    assert 0.35 < found["overlap"] < 0.7  # rendered with a half
    assert found["plan"]["seconds"] > 0
    assert found["plan"]["memory_bytes"] > 2**20
    assert found["plan"]["canvas_size"][0] > 800


def test_twelve_bits_in_sixteen_are_as_bright_as_eight(frames: list[Path], tmp_path: Path) -> None:
    for frame in frames:
        cv2.imwrite(str(tmp_path / frame.name), cv2.imread(str(frame)).astype(np.uint16) * 16)
    dark, burnt = (cv2.imread(str(frames[0])) * factor for factor in (0.05, 3.0))
    cv2.imwrite(str(tmp_path / "dark.png"), np.rint(dark * 16).astype(np.uint16))
    cv2.imwrite(str(tmp_path / "burnt.png"), np.minimum(np.rint(burnt * 16), 4095).astype(np.uint16))
    found = examine(tmp_path)
    assert (found.dark, found.burnt) == (("dark.png",), ("burnt.png",))


def test_faults_are_found(frames: list[Path], stranger: Path, tmp_path: Path, rdstitch: Run) -> None:
    copied(frames, tmp_path)
    copied([stranger], tmp_path, "stranger.png")
    sharp = cv2.imread(str(frames[1]))
    cv2.imwrite(str(tmp_path / "blurred.png"), cv2.GaussianBlur(sharp, (0, 0), 3.0))
    cv2.imwrite(str(tmp_path / "burnt.png"), np.minimum(sharp * 3.0, 255).astype(np.uint8))
    cv2.imwrite(str(tmp_path / "dark.png"), sharp // 20)
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8 no image")
    cv2.imwrite(str(tmp_path / "dot.png"), np.full((1, 1, 3), 99, np.uint8))
    holes = cv2.cvtColor(sharp, cv2.COLOR_BGR2GRAY).astype(np.float32) / 255
    holes[:50] = np.nan
    cv2.imwrite(str(tmp_path / "holes.tif"), holes)
    found = examine(tmp_path)
    assert found.images == 9
    assert len(found.unreadable) == 1
    assert found.blurred == ("blurred.png", "dot.png")  # that has no detail
    assert found.burnt == ("burnt.png",)
    assert found.dark == ("dark.png",)
    assert "stranger.png" in found.alone
    assert not {frame.name for frame in frames} & set(found.alone)
    text = rdstitch("doctor", tmp_path).out
    assert "broken.jpg" in text
    assert "leave blurred images out" in text


def test_zooms_and_cameras_are_told_apart(frames: list[Path], tmp_path: Path, rdstitch: Run) -> None:
    for number, (frame, focal, model) in enumerate(zip(frames, (24, 24, 50), ("A", "A", "B"), strict=True)):
        exif = Image.Exif()
        exif[ExifTags.Base.Model] = model
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal
        with Image.open(frame) as image:
            image.save(tmp_path / f"{number}.jpg", exif=exif, quality=95)
    found = examine(tmp_path)
    assert found.cameras == (("A", 2), ("B", 1))
    assert found.advice[0].startswith("the images come from 2 cameras")
    assert (len(found.focal_px), found.zoomed) == (3, True)
    text = rdstitch("doctor", tmp_path).out
    assert "by EXIF in 3 of 3" in text
    assert "advice:     the images come from 2 cameras" in text
    assert "advice:     the lens was zoomed" in text
    with Image.open(frames[2]) as image:
        image.save(tmp_path / "2.jpg", quality=95)
    assert "the images come from" not in rdstitch("doctor", tmp_path).out  # one says nothing of its camera


def test_images_that_have_nothing_in_common(frames: list[Path], stranger: Path, rdstitch: Run) -> None:
    found = examine([frames[0], stranger])
    assert found.overlap is None
    assert (found.plan, found.alone) == (None, (frames[0].name, stranger.name))
    assert "overlap" in found.problems[0].text
    rdstitch("doctor", "no_such_file.jpg", status=3)


@pytest.mark.parametrize("single", [True, False])
def test_arrays(frames: list[Path], single: bool) -> None:
    images = [np.asarray(Image.open(frame)) for frame in frames]
    found = examine(images[0] if single else images, channel_order="rgb")
    assert (found.images, found.plan is None) == ((1, True) if single else (3, False))


def test_one_image_is_too_few(frames: list[Path], rdstitch: Run) -> None:
    assert "needs two images" in rdstitch("doctor", frames[0]).out


def test_what_cannot_be_laid_out_is_an_advice(frames: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def too_large(*_arguments: object, **_options: object) -> None:
        raise LimitError("the horizon is in the image")

    monkeypatch.setattr(doctor, "mosaic", too_large)
    found = doctor.examine(frames)
    assert (found.plan, [problem.text for problem in found.problems]) == (None, ["the horizon is in the image"])
