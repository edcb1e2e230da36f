"""Pictures taken by turning on the spot, from files to a panorama, through the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rdstitch.camera import Camera
from rdstitch.synthetic.panorama import TurningSequence, panorama_rotations, turning_sequence
from rdstitch.synthetic.rendering import Photometry
from tests.cli.running import Run

LENS = Camera((320, 240), -0.2, focal=260.0, focal_source="option")


def _written(count: int, step: float, folder: Path) -> tuple[TurningSequence, list[Path]]:
    rotations = panorama_rotations(count, np.radians(step), seed=1)
    sequence = turning_sequence(LENS, rotations, seed=2, photometry=Photometry(noise=0.005))
    return sequence, sequence.write(folder)


@pytest.fixture(scope="module")
def around(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Nine pictures that go all the way round; never written to."""
    return _written(9, 40.0, tmp_path_factory.mktemp("around"))[1]


def test_a_full_turn_becomes_a_sphere_that_viewers_turn(rdstitch: Run, around: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "sphere.jpg"
    report = tmp_path / "report.html"
    done = rdstitch("pano", *around, "-o", output, "--report", report)
    assert done.status == 0
    record = json.loads((tmp_path / "sphere.jpg.json").read_text(encoding="utf-8"))
    assert record["model"] == "rotation"
    assert all(image["used"] for image in record["images"])
    assert record["lambda"] == pytest.approx(-0.2, abs=0.005)
    assert record["focal_px"] == pytest.approx(260.0, rel=0.003)
    assert record["output"]["projection"] == "sphere"
    assert record["output"]["wraps_around"]
    assert record["output"]["field_of_view_deg"][0] == pytest.approx(360.0)
    width, height = record["output"]["size"]
    assert abs(width - 2 * np.pi * 260.0) < 0.02 * width
    with Image.open(output) as picture:
        xmp = picture.info["xmp"].decode()
    assert f'GPano:FullPanoWidthPixels="{width}"' in xmp
    assert f'GPano:CroppedAreaImageHeightPixels="{height}"' in xmp
    again = tmp_path / "again.jpg"
    assert rdstitch("apply", f"{output}.json", "--images", around[0].parent, "-o", again).status == 0
    assert again.read_bytes() == output.read_bytes()
    page = report.read_text(encoding="utf-8")
    assert "<h2>Directions</h2>" in page
    assert "9 pictures show 360 x" in page


def test_the_projection_is_the_users(rdstitch: Run, around: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "few.tif"
    done = rdstitch("pano", *around[:3], "-o", output, "--projection", "mercator")
    assert done.status == 0
    record = json.loads((tmp_path / "few.tif.json").read_text(encoding="utf-8"))
    assert record["output"]["projection"] == "mercator"
    assert not record["output"]["wraps_around"]


def test_pictures_of_a_plane_have_no_other_projection(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    done = rdstitch("pano", *frames, "-o", tmp_path / "out.png", "--projection", "sphere")
    assert done.status == 2
    assert "--projection" in done.err


def test_a_lens_is_calibrated_by_turning(rdstitch: Run, around: list[Path], tmp_path: Path) -> None:
    camera = tmp_path / "camera.json"
    done = rdstitch("calibrate", around[0].parent, "-o", camera)
    assert done.status == 0
    found = Camera.load(camera)
    assert found.distortion == pytest.approx(-0.2, abs=0.005)
    assert found.focal == pytest.approx(260.0, rel=0.003)


def test_a_turning_camera_has_no_path(rdstitch: Run, around: list[Path], tmp_path: Path) -> None:
    done = rdstitch("trajectory", around[0].parent, "-o", tmp_path / "path.csv")
    assert done.status == 2
    assert "turned on the spot" in done.err
