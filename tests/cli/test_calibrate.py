"""``rdstitch calibrate``, run for real."""

from pathlib import Path

from rdstitch.camera import Camera
from tests.cli.running import DISTORTION, FAST, Run


def test_writes_a_camera_that_pano_takes(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    done = rdstitch("calibrate", frames[0].parent, "-o", file, *FAST)
    assert (done.status, done.err) == (0, "")
    camera = Camera.load(file)
    assert done.out == f"{camera.distortion:.6f}\n"
    assert abs(camera.distortion - DISTORTION) < 0.01
    assert camera.image_size == (400, 300)
    assert [path.name for path in tmp_path.iterdir()] == ["camera.json"]

    stitched = rdstitch("pano", *frames[:2], "-o", tmp_path / "pano.jpg", "--camera", file, *FAST)
    assert (stitched.status, stitched.out) == (0, done.out)


def test_keeps_an_existing_camera_file(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    file.write_text("mine", encoding="utf-8")
    done = rdstitch("calibrate", *frames, "-o", file, *FAST)
    assert done.status == 6
    assert str(file) in done.line
    assert "--overwrite" in done.line
    assert file.read_text(encoding="utf-8") == "mine"
    assert rdstitch("calibrate", *frames, "-o", file, "--overwrite", *FAST).status == 0
    assert Camera.load(file).image_size == (400, 300)
