"""``rdstitch calibrate``, run for real."""

import json
import re
from pathlib import Path

import pytest

from rdstitch.camera import Camera
from rdstitch.camera_files import load_camera
from tests.cli.running import CACHED, DISTORTION, Run


def test_writes_a_camera_that_pano_takes(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    done = rdstitch("calibrate", frames[0].parent, "-o", file, *CACHED)
    camera = Camera.load(file)
    first, *others = done.err.splitlines()
    assert first == f"rdstitch: λ = {camera.distortion:.6f} ± {camera.distortion_std:.6f}"
    assert "rdstitch: second coefficient not needed" in others
    assert not re.search("warning|pixels from the lens", done.err)
    assert done.out == f"{camera.distortion:.6f}\n"
    assert abs(camera.distortion - DISTORTION) < 0.01
    assert camera.image_size == (400, 300)
    assert [path.name for path in tmp_path.iterdir()] == ["camera.json"]

    stitched = rdstitch("pano", *frames[:2], "-o", tmp_path / "pano.jpg", "--camera", file, *CACHED)
    assert (stitched.status, stitched.out) == (0, done.out)


@pytest.mark.parametrize("name", ["camera.yml", "cameras.json", "lens.pto"])
def test_camera_files_of_others(rdstitch: Run, frames: list[Path], tmp_path: Path, name: str) -> None:
    done = rdstitch("calibrate", *frames[:2], "-o", tmp_path / name, *CACHED)
    assert re.search(rf"{name}: its lens model is at most 0\.\d+ pixels from the lens", done.err)
    assert f"{load_camera(tmp_path / name).distortion:.6f}\n" == done.out
    rdstitch("undistort", frames[0], "--camera", tmp_path / name, "-o", tmp_path / "straight", err="")


def test_the_residual_of_a_foreign_lens_is_reported(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    entry = {"projection_type": "perspective", "width": 400, "height": 300, "focal": 0.95, "k1": -0.2, "k2": 0.02}
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"lens": entry}), encoding="utf-8")
    arguments = ("undistort", frames[0], "--camera", file, "-o", tmp_path / "straight", "--overwrite")
    told = rdstitch(*arguments)
    assert re.search(r"OpenDroneMap.* rms \d+\.\d\d pixels", told.line)
    rdstitch(*arguments, "-q", err="")
