"""Images that are there twice, or nearly: they count for nothing, and are in every output all the same."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from rdstitch.io.read import read_image
from rdstitch.io.write import write_image
from rdstitch.synthetic.textures import ground
from tests.cli.running import FAST, Run, copied, flight, rows_of, sidecar_of

ORDERS = {"first": "cdabe", "between": "acdbe", "last": "abecd"}  # c is a copy of a, d nearly one


@pytest.fixture(scope="module")
def crops(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of one picture, moved by whole pixels."""
    folder = tmp_path_factory.mktemp("crops")
    whole = np.rint(ground((720, 400), 3).region(0, 0, 720, 400) * 255).astype(np.uint8)
    for name, (x, y) in {"a": (10, 20), "b": (160, 40), "c": (10, 20), "d": (14, 22), "e": (310, 10)}.items():
        write_image(folder / f"{name}.png", whole[y : y + 300, x : x + 400])
    return folder


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """From above; images are cut so that one can be moved by four pixels."""
    folder = tmp_path_factory.mktemp("copies")
    a, b, e = (read_image(file).pixels for file in flight(3, 3, overlap=0.6).write(folder, "whole_{}.png"))
    for name, pixels in {"a": a, "b": b, "c": a, "e": e}.items():
        write_image(folder / f"{name}.png", pixels[:, :-4])
    write_image(folder / "d.png", a[:, 4:])
    return folder


def _ordered(folder: Path, order: str, place: Path) -> Path:
    """A folder with the images in an order that is that of their names."""
    for k, name in enumerate(ORDERS[order]):
        copied([folder / f"{name}.png"], place / "images", f"{k}{name}.png")
    return place / "images"


def _all_used(output: Path) -> None:
    images, pairs = (sidecar_of(output)[key] for key in ("images", "pairs"))
    assert [image["used"] for image in images] == [True] * 5
    assert all(pair["used"] or pair["dropped"] or not pair["ok"] for pair in pairs)
    assert any("copy" in pair["dropped"] for pair in pairs)


def _linked(text: str, pattern: str) -> set[str]:
    return {name for pair in re.findall(pattern, text) for name in pair}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("recipe", ["mosaic", "pano"])
def test_of_crops_whole_pixels_are_kept(rdstitch: Run, crops: Path, tmp_path: Path, recipe: str, order: str) -> None:
    output, page = tmp_path / "all.tif", tmp_path / "all.html"
    images = _ordered(crops, order, tmp_path)
    rdstitch(recipe, images, "-o", output, "--report", page, *FAST)
    _all_used(output)
    assert "whole pixels" in sidecar_of(output)["model_reason"]
    places = {image["name"][1]: np.array(image["to_output"]) for image in sidecar_of(output)["images"]}
    np.testing.assert_allclose(places["a"], places["c"], atol=1e-9)
    assert _linked(page.read_text(), r"<title>(\d)\w\.png and (\d)\w\.png: ") == set("01234")
    rdstitch("apply", f"{output}.json", "--images", images, "-o", tmp_path / "again.tif", "-j", "1")
    np.testing.assert_array_equal(read_image(output).pixels, read_image(tmp_path / "again.tif").pixels)


@pytest.mark.parametrize(("size", "again"), [((393, 295), 0), ((407, 305), 0), ((407, 305), 2)])
def test_one_that_the_model_of_others_cannot_hold_is_none(
    rdstitch: Run, crops: Path, tmp_path: Path, size: tuple[int, int], again: int
) -> None:
    """A camera that zooms by 1.8 % moves all by less than a near copy may; also where that is saved again."""
    folder = tmp_path / "images"
    copied([crops / f"{name}.png" for name in "abe"], folder)
    around = (np.array(size) - (400, 300)) / 2
    zoom = np.array([[size[0] / 400, 0, -around[0]], [0, size[1] / 300, -around[1]]])
    pixels = cv2.warpAffine(read_image(crops / "a.png").pixels, zoom, (400, 300), flags=cv2.INTER_CUBIC, borderMode=4)
    write_image(folder / "z.png", pixels)
    for k in range(again):
        write_image(folder / f"z{k}.jpg", pixels)
    rdstitch("mosaic", folder, "-o", tmp_path / "all.png", *FAST)
    found = sidecar_of(tmp_path / "all.png")
    assert [image["used"] for image in found["images"]] == [True] * (4 + again)
    zoomed = [pair for pair in found["pairs"] if "z.png" in pair["images"] and pair["ok"]]
    assert zoomed
    assert all((pair["used"] or again) and pair["rms_of_whole_px"] < 0.3 for pair in zoomed)


@pytest.mark.parametrize("order", ORDERS)
def test_every_output_holds_them(rdstitch: Run, frames: Path, tmp_path: Path, order: str) -> None:
    images, project, page = _ordered(frames, order, tmp_path), tmp_path / "all.pto", tmp_path / "all.dzi"
    more = ("--hugin-project", project, "--report", tmp_path / "report.html")
    rdstitch("mosaic", images, "-o", page, *more, *FAST)
    _all_used(page)
    assert _linked(project.read_text(), r"(?m)^c n(\d) N(\d)") == set("01234")
    assert _linked((tmp_path / "report.html").read_text(), r"<title>(\d)\w\.png and (\d)\w\.png: ") == set("01234")
    assert "more of copies" in (tmp_path / "report.html").read_text()
    assert '["matches", "0"]' not in page.with_suffix(".html").read_text()


@pytest.mark.parametrize("order", ORDERS)
def test_of_poses_and_lenses(rdstitch: Run, frames: Path, tmp_path: Path, order: str) -> None:
    poses, camera, images = tmp_path / "poses.csv", tmp_path / "camera.yaml", _ordered(frames, order, tmp_path)
    rdstitch("trajectory", images, "-o", poses, *FAST)
    rows = {row["name"][1]: row for row in rows_of(poses)}
    assert rows.keys() == {*"abcde"}
    assert [rows["a"][key] for key in ("x", "y", "yaw_deg")] == [rows["c"][key] for key in ("x", "y", "yaw_deg")]
    rdstitch("calibrate", images, "-o", camera, *FAST)


def test_a_copy_of_a_near_copy_can_be_the_reference(rdstitch: Run, frames: Path, tmp_path: Path) -> None:
    (saved_again,) = copied([frames / "d.png"], tmp_path, "f.png")
    files = [frames / "a.png", frames / "d.png", saved_again, frames / "b.png", frames / "e.png"]
    outcome = rdstitch("mosaic", *files, "-o", tmp_path / "all.png", "--reference", "f.png", *FAST)
    assert "another one is taken" not in outcome.err
    assert sidecar_of(tmp_path / "all.png")["reference"] == "d.png"  # which lies where it does
