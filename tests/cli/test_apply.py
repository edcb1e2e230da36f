"""``rdstitch apply``, run for real."""

import json
import os
import shutil
import sys
import unicodedata
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import PIL.Image
import pytest

from rdstitch import CompositeOptions, apply, mosaic, write_report
from rdstitch.errors import ArgumentError, InputError
from rdstitch.io.metadata import read_metadata
from rdstitch.io.read import read_image
from rdstitch.sidecar.read import read_sidecar
from tests.cli.running import CACHED, OPTIONS, Outcome, Run, copied, finished, sidecar_of, start


def _sidecar(image: Path) -> Path:
    return image.with_name(image.name + ".json")


def _apply(rdstitch: Run, sidecar: Path, images: Path, output: Path, *options: str, **checked: object) -> Outcome:
    return rdstitch("apply", sidecar, "--images", images, "-o", output, "-j", "1", *options, **checked)


def test_same_images_give_the_same_bytes(rdstitch: Run, frames: list[Path], stitched: Path, tmp_path: Path) -> None:
    output = tmp_path / "again.tif"
    _apply(rdstitch, _sidecar(stitched), frames[0].parent, output, out="", err="")
    assert output.read_bytes() == stitched.read_bytes()
    then, now = (sidecar_of(image) for image in (stitched, output))
    assert now.pop("applied") == {"sidecar": str(_sidecar(stitched)), "matched": "name"}
    assert (now.pop("pairs"), now["output"].pop("file")) == ([], "again.tif")
    assert now == {key: value for key, value in then.items() if key != "pairs"} | {"output": now["output"]}

    third = tmp_path / "third.tif"
    _apply(rdstitch, _sidecar(output), frames[0].parent, third)
    assert third.read_bytes() == stitched.read_bytes()


def test_a_cropped_image_has_the_same_bytes_again(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    """Seams are decided on the whole canvas, as before; and of fewer images the same pixels are left."""
    image, again, fewer = (tmp_path / f"{name}.tif" for name in ("a", "again", "fewer"))
    rdstitch("mosaic", *frames, "-o", image, "--crop", *CACHED)
    _apply(rdstitch, _sidecar(image), frames[0].parent, again)
    assert again.read_bytes() == image.read_bytes()
    assert sidecar_of(again)["options"] == sidecar_of(image)["options"]
    _apply(rdstitch, _sidecar(again), frames[0], fewer, told="left out")
    then, now = (sidecar_of(written)["output"] for written in (image, fewer))
    assert (now["size"], now["plane_to_output"]) == (then["size"], then["plane_to_output"])


def test_lambda_of_a_lens_with_two_coefficients_is_that_of_the_nearest_one(
    rdstitch: Run, frames: list[Path], tmp_path: Path
) -> None:
    image, again = tmp_path / "a.tif", tmp_path / "again.tif"
    rdstitch("mosaic", *frames, "-o", image, "--lens", "division2", *CACHED)
    _apply(rdstitch, _sidecar(image), frames[0].parent, again)
    then, now = (sidecar_of(written) for written in (image, again))
    assert then["camera"]["coefficients"][1] != 0.0
    assert now["lambda"] == now["camera"]["lambda"] == then["lambda"] == then["camera"]["lambda"]
    assert now["camera"] == then["camera"]


def test_options_of_the_compositor_replace_those_of_the_sidecar_one_by_one(
    frames: list[Path], stitched: Path, tmp_path: Path
) -> None:
    content = sidecar_of(stitched)
    content["options"]["composite"] |= {"blend": "none", "exposure": "none"}
    changed = tmp_path / "changed.json"
    changed.write_text(json.dumps(content), encoding="utf-8")
    result = apply(changed, frames, scale=0.5, workers=1)
    assert (result.options.composite.scale, result.options.composite.blend) == (0.5, "none")
    assert apply(changed, frames, composite=CompositeOptions(scale=0.5)).options.composite.blend == "multiband"
    with pytest.raises(ArgumentError, match="a report is made of a StitchResult or a Registration, not of a Recompos"):
        write_report(tmp_path / "r.html", result)  # type: ignore[arg-type]


def test_local_alignment_is_applied_again(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    """With a number of cells it is used on a plane too; there, "auto" is the same as "off", byte for byte."""
    made = {}
    for choice in ("auto", "off", "5"):
        made[choice] = tmp_path / f"{choice}.png"
        rdstitch("mosaic", *frames, "-o", made[choice], "--local-alignment", choice, *CACHED)
    assert made["auto"].read_bytes() == made["off"].read_bytes() != made["5"].read_bytes()
    content = sidecar_of(made["5"])
    assert content["local_alignment"]["used"]
    assert content["images"][0]["displacement"]["grid"] == [6, 5]
    assert sidecar_of(made["auto"])["images"][0]["displacement"] is None
    again = tmp_path / "again.png"
    _apply(rdstitch, _sidecar(made["5"]), frames[0].parent, again)
    assert again.read_bytes() == made["5"].read_bytes()

    content["images"][0]["displacement"]["px"].pop()
    _sidecar(made["5"]).write_text(json.dumps(content), encoding="utf-8")
    refused = _apply(rdstitch, _sidecar(made["5"]), frames[0].parent, tmp_path / "no.png", status=3)
    assert "images[0].displacement: expected" in refused.err


def test_an_image_of_another_size_brings_its_own_displacement_time_and_place(
    rdstitch: Run, frames: list[Path], tmp_path: Path
) -> None:
    small, twice = tmp_path / "small.png", tmp_path / "twice.png"
    rdstitch("mosaic", *frames, "-o", small, "--local-alignment", "5", *CACHED)
    content = sidecar_of(small)
    for image in content["images"]:
        image |= {"timestamp": 1.0, "gps": [47.0, 8.0, None]}  # of the images that were registered, not of these
    _sidecar(small).write_text(json.dumps(content), encoding="utf-8")
    large = _written(frames, tmp_path / "large", [frame.name for frame in frames], factor=2.0)
    _apply(rdstitch, _sidecar(small), large, twice)
    for then, now in zip(content["images"], sidecar_of(twice)["images"], strict=True):
        np.testing.assert_allclose(now["displacement"]["px"], 2.0 * np.array(then["displacement"]["px"]))
        assert (now["timestamp"], now["gps"]) == (None, None)


def test_given_options_win_over_the_sidecar(rdstitch: Run, frames: list[Path], stitched: Path, tmp_path: Path) -> None:
    changed, direct = tmp_path / "changed.png", tmp_path / "direct.png"
    options = ("--scale", "0.4", "--rotate", "0", "--blend", "feather")
    _apply(rdstitch, _sidecar(stitched), frames[0].parent, changed, *options)
    rdstitch("mosaic", *frames, "-o", direct, *options, *CACHED)
    assert changed.read_bytes() == direct.read_bytes()
    record = sidecar_of(stitched)
    record["options"]["composite"]["max_memory"] = 1000  # bytes of another machine
    (tmp_path / "elsewhere.json").write_text(json.dumps(record), encoding="utf-8")
    _apply(rdstitch, tmp_path / "elsewhere.json", frames[0].parent, changed, *options, "--overwrite")
    assert changed.read_bytes() == direct.read_bytes()


def _written(frames: list[Path], folder: Path, names: list[str], factor: float = 1.0, band: int | None = None) -> Path:
    """The frames under other names, in another size, or one band of them."""
    folder.mkdir()
    for frame, name in zip(frames, names, strict=True):
        image = cv2.imread(str(frame))
        if band is not None:
            image = image[..., band]
        assert cv2.imwrite(str(folder / name), cv2.resize(image, None, fx=factor, fy=factor))
    return folder


def test_images_of_another_size(rdstitch: Run, frames: list[Path], stitched: Path, tmp_path: Path) -> None:
    # The same names before the suffix.
    large = _written(frames, tmp_path / "large", [frame.stem + ".bmp" for frame in frames], factor=2.0)
    _apply(rdstitch, _sidecar(stitched), large, tmp_path / "large.tif", err="")
    small, twice = read_image(stitched), read_image(tmp_path / "large.tif")
    assert np.abs(np.array(twice.pixels.shape[:2]) - 2 * np.array(small.pixels.shape[:2])).max() <= 2
    height, width = small.pixels.shape[:2]
    reduced = cv2.resize(twice.pixels, (width, height), interpolation=cv2.INTER_AREA)
    inside = cv2.erode(small.alpha, np.ones((15, 15), np.uint8)) > 0
    a, b = (image[inside].astype(float).ravel() for image in (reduced, small.pixels))
    assert np.corrcoef(a, b)[0, 1] > 0.98
    record = sidecar_of(tmp_path / "large.tif")
    assert [image["size"] for image in record["images"]] == [[800, 600]] * 3
    assert record["camera"]["image_size"] == [800, 600]
    assert record["lambda_px"] == pytest.approx(record["lambda"] / 500.0**2)
    _apply(rdstitch, tmp_path / "large.tif.json", frames[0].parent, tmp_path / "small.tif", err="")
    # Centres are divided by two again; nothing else was rounded.
    assert read_image(tmp_path / "small.tif").pixels.shape == small.pixels.shape


def test_another_band_in_order(rdstitch: Run, frames: list[Path], stitched: Path, tmp_path: Path) -> None:
    band = _written(frames, tmp_path / "nir", [f"nir{index}.png" for index in (1, 2, 10)], band=1)
    _apply(rdstitch, _sidecar(stitched), band, tmp_path / "nir.tif", status=3, told="--match order")
    _apply(rdstitch, _sidecar(stitched), band, tmp_path / "nir.tif", "--match", "order", err="")
    colour = tmp_path / "colour.tif"
    _apply(rdstitch, _sidecar(stitched), frames[0].parent, colour)
    grey, green = read_image(tmp_path / "nir.tif").pixels, read_image(colour).pixels[..., 1]
    assert grey.shape == green.shape
    assert np.abs(grey.astype(float) - green).mean() < 3.0
    _apply(rdstitch, _sidecar(stitched), band, tmp_path / "n.tif", "--match", "name", status=3, told=frames[0].name)


def test_numbers_that_begin_elsewhere_are_no_names(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    registered = _written(frames, tmp_path / "red", [f"V{k:02}_RED.png" for k in (0, 1, 2)])
    rdstitch("mosaic", registered, "-o", tmp_path / "r.png", *CACHED)
    shifted = _written(frames, tmp_path / "nir", [f"V{k:02}_NIR.png" for k in (1, 2, 3)], band=1)
    sidecar, output = tmp_path / "r.png.json", tmp_path / "n.png"
    _apply(rdstitch, sidecar, shifted, output, status=3, told="V02_NIR.png takes its place in order; say which holds")
    _apply(rdstitch, sidecar, shifted, output, "--match", "order", err="")
    fewer = _written(frames[1:], tmp_path / "fewer", [f"V{k:02}_NIR.png" for k in (1, 2)], band=1)
    _apply(rdstitch, sidecar, fewer, output, "--overwrite", told="V00_RED.png")


def test_originals_are_found_from_the_folder_of_the_sidecar(
    frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that another band's lens is compared wherever one stands, and no image of the current one is an original."""
    flight, elsewhere = tmp_path / "flight", tmp_path / "elsewhere"
    elsewhere.mkdir()
    _written(frames, flight, [frame.name for frame in frames])
    monkeypatch.chdir(flight)
    mosaic([frame.name for frame in frames], "../elsewhere/o.tif", OPTIONS)
    sidecar = elsewhere / "o.tif.json"
    assert [image["path"] for image in sidecar_of(elsewhere / "o.tif")["images"]] == [
        f"../flight/{frame.name}" for frame in frames
    ]
    shifted = _written(frames, tmp_path / "shifted", [frame.name for frame in frames])
    for k, file in enumerate(sorted(shifted.iterdir())):
        assert cv2.imwrite(str(file), np.roll(cv2.imread(str(file)), (12 * k, -9 * k), axis=(0, 1)))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="was not taken from the same place"):
        apply(sidecar, [shifted])
    sidecar.write_text(sidecar.read_text("utf-8").replace("../flight/", ""), "utf-8")
    assert any("was not compared" in message.text for message in apply(sidecar, [shifted]).messages)
    monkeypatch.chdir(flight)
    assert any("was not compared" in message.text for message in apply(sidecar, [shifted]).messages)


@pytest.mark.parametrize("given", ["files", "files that are gone", "arrays"])
def test_images_that_are_left_out_keep_their_paths(
    frames: list[Path], stranger: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
) -> None:
    """From the folder of the new sidecar on, though the other one was named absolutely."""
    flight, new = copied([*frames[:2], stranger], tmp_path / "flight"), tmp_path / "new" / "o.tif"
    new.parent.mkdir()
    monkeypatch.chdir(tmp_path / "flight")
    images = [cv2.imread(file.name) if given == "arrays" else file.name for file in flight]
    mosaic(images, "o.tif", OPTIONS)
    if given == "files that are gone":
        flight[2].unlink()
        del images[2]
    apply(tmp_path / "flight" / "o.tif.json", images, new)
    names = [f"image_{k:04}" for k in range(3)] if given == "arrays" else [f"../flight/{file.name}" for file in flight]
    written = sidecar_of(new)["images"]
    assert [image["path"] for image in written] == names
    assert [image["used"] for image in written] == [True, True, False]


def test_equal_names_of_another_flight_are_refused_and_other_images_named(
    frames: list[Path], stitched: Path, tmp_path: Path
) -> None:
    taken = _written(frames, tmp_path / "taken", [frame.stem + ".jpg" for frame in frames])
    saved, times = read_sidecar(_sidecar(stitched)), []
    for k, file in enumerate(sorted(taken.iterdir())):
        exif = PIL.Image.Exif()
        exif[0x8769] = {0x9003: f"2024:05:06 07:08:{10 * k:02}"}
        PIL.Image.open(file).save(file, exif=exif)
        times.append(read_metadata(file).timestamp)
    for image, time in zip(saved.images, times[1:] + times[:1], strict=True):
        image.timestamp = time
    with pytest.raises(InputError, match="was taken at the time or place"):
        apply(saved, [taken])
    (tmp_path / "more.png").write_bytes(frames[0].read_bytes())
    result = apply(saved, [*frames, tmp_path / "more.png"])
    assert [message.images for message in result.messages] == [(str(tmp_path / "more.png"),)]


def test_a_missing_image_is_named(rdstitch: Run, frames: list[Path], stitched: Path, tmp_path: Path) -> None:
    folder = tmp_path / "some"
    copied(frames[:2], folder)
    _apply(rdstitch, _sidecar(stitched), folder, tmp_path / "some.tif", told=frames[2].name)
    assert [image["used"] for image in sidecar_of(tmp_path / "some.tif")["images"]] == [True, True, False]
    _apply(rdstitch, _sidecar(stitched), folder, tmp_path / "strict.tif", "--strict", status=5)
    assert not (tmp_path / "strict.tif").exists()


def test_images_of_one_name_in_two_folders(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("cam0", "cam1")]
    for folder, frame in zip(folders, frames, strict=False):
        copied([frame], folder, "x.png")
    output, layers = tmp_path / "out.png", tmp_path / "layers"
    rdstitch("mosaic", *folders, "-o", output, "--layers", layers, *CACHED)
    assert [image["name"] for image in sidecar_of(output)["images"]] == ["cam0/x.png", "cam1/x.png"]
    assert {file.name for file in layers.iterdir()} == {
        f"cam{k}_x{kind}.tif" for k in range(2) for kind in ("", "_mask")
    }
    # Whatever order they are given in, each is in its place.
    _apply(rdstitch, _sidecar(output), folders[1], tmp_path / "again.png", "--images", str(folders[0]))
    np.testing.assert_array_equal(read_image(tmp_path / "again.png").pixels, read_image(output).pixels)
    _apply(rdstitch, _sidecar(output), folders[1], tmp_path / "one.png", told=f"left out {folders[0] / 'x.png'}")


def test_layers_are_called_as_was_checked(rdstitch: Run, place: Path) -> None:
    """Of images that are left out, too, names tell others apart; a dry run makes no folder."""
    (place / "a.jpg").write_bytes(b"no image")
    wanted = ("mosaic", place, "-o", place / "o.tif", "--layers", place / "new" / "layers", *CACHED)
    rdstitch(*wanted, "--dry-run")
    assert not (place / "new").exists()
    rdstitch(*wanted, told="a.jpg")
    names = {file.name for file in (place / "new" / "layers").iterdir()}
    assert names == {"a.png.tif", "a.png_mask.tif", "b.png.tif", "b.png_mask.tif"}


def test_layers_whose_masks_would_be_called_like_another(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    copied(frames, tmp_path, "a.png", "a_mask.png")
    layers = tmp_path / "layers"
    rdstitch("mosaic", tmp_path, "-o", tmp_path / "out.jpg", "--layers", layers, *CACHED)
    assert {file.name for file in layers.iterdir()} == {
        f"{name}.png{kind}.tif" for name in ("a", "a_mask") for kind in ("", "_mask")
    }


def test_what_does_not_fit_is_refused(rdstitch: Run, frames: list[Path], stitched: Path, tmp_path: Path) -> None:
    sidecar = _sidecar(stitched)
    fewer = _written(frames[:2], tmp_path / "fewer", ["x.png", "y.png"])
    _apply(rdstitch, sidecar, fewer, tmp_path / "out.tif", status=3, told=str(sidecar))
    nowhere = tmp_path / "nowhere"
    _apply(rdstitch, sidecar, nowhere, tmp_path / "out.tif", status=3, told=f"{nowhere}: no such folder")
    cut = tmp_path / "cut"
    cut.mkdir()
    for frame in frames:
        assert cv2.imwrite(str(cut / frame.name), read_image(frame).pixels[:200])
    _apply(rdstitch, sidecar, cut, tmp_path / "out.tif", status=3, told=str(cut / frames[0].name))
    shutil.copy(frames[0], cut / f"{frames[0].stem}.jpeg")
    for image in cut.glob("*.png"):
        image.rename(image.with_suffix(".bmp"))
    _apply(rdstitch, sidecar, cut, tmp_path / "out.tif", status=3, told="several images")
    _apply(rdstitch, frames[0], frames[0].parent, tmp_path / "out.tif", status=3)
    assert not (tmp_path / "out.tif").exists()


def test_never_writes_over_its_sidecar(rdstitch: Run, frames: list[Path], stitched: Path, tmp_path: Path) -> None:
    copied([stitched, _sidecar(stitched)], tmp_path)
    own = tmp_path / stitched.name
    _apply(rdstitch, _sidecar(own), frames[0].parent, own, "--overwrite", status=6, told=str(own))
    assert _sidecar(own).read_bytes() == _sidecar(stitched).read_bytes()
    _apply(rdstitch, _sidecar(stitched), frames[0].parent, own, status=6)
    mask = tmp_path / "mask.png"
    mask.write_bytes(frames[0].read_bytes())
    with_mask = ("--mask", str(mask), "--overwrite")
    _apply(rdstitch, _sidecar(stitched), frames[0].parent, mask, *with_mask, status=6, told="read")
    _apply(rdstitch, _sidecar(stitched), frames[0].parent, own, "--overwrite")


_LATIN = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "latin-1"}
_UTF8 = {"LC_ALL": "C", "PYTHONUTF8": "1"}


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes")
@pytest.mark.parametrize(("written", "composed"), [(_LATIN, "NFD"), (_UTF8, "NFC")], ids=["ascii", "utf-8"])
def test_names_match_whatever_the_locale(
    frames: list[Path], tmp_path: Path, written: dict[str, str], composed: Literal["NFC", "NFD"]
) -> None:
    names = [f"gr\u00fcn_{k}.png" for k in range(3)]
    forms: list[tuple[str, Literal["NFC", "NFD"]]] = [("a", "NFC"), ("b", composed)]
    for folder, form in forms:
        copied(frames, tmp_path / folder, *(os.fsdecode(unicodedata.normalize(form, name).encode()) for name in names))
    read = _UTF8 if written is _LATIN else _LATIN
    options = ("--max-features", "600", "-j", "1")
    made = start("mosaic", tmp_path / "a", "-o", tmp_path / "out.tif", *options, environment=written)
    assert finished(made).status == 0
    images = ("--images", tmp_path / "b", "-o", tmp_path / "new.tif")
    said = finished(start("apply", tmp_path / "out.tif.json", *images, environment=read))
    assert (said.status, "taken in order" in said.err) == (0, False)
    saved = sidecar_of(tmp_path / "new.tif")
    assert saved["applied"]["matched"] == "name"
    assert [image["name"] for image in saved["images"]] == names
