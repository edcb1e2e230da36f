"""``rdstitch undistort``, run for real."""

from pathlib import Path

import numpy as np
from PIL import Image

from rdstitch.camera import Camera
from rdstitch.io import read_image
from rdstitch.synthetic import Sequence
from tests.cli.running import DISTORTION, FAST, Run


def test_undistorted_pixels_are_where_the_model_says(
    rdstitch: Run, frames: list[Path], sequence: Sequence, tmp_path: Path
) -> None:
    done = rdstitch("undistort", *frames, "--lambda", str(DISTORTION), "-o", tmp_path / "new" / "folder")
    assert (done.status, done.out, done.err) == (0, "", "")
    written = sorted((tmp_path / "new" / "folder").iterdir())
    assert [path.name for path in written] == [path.name for path in frames]
    straight, bent = read_image(written[0]).pixels, read_image(frames[0]).pixels
    assert straight.shape == bent.shape
    camera = Camera((400, 300), distortion=DISTORTION)
    # Points between the middle and the corner, where the lens moves them by many pixels.
    u, v = np.meshgrid(np.arange(230, 370), np.arange(180, 280))
    measured = camera.distort(np.stack([u, v], axis=-1))
    assert np.linalg.norm(measured - np.stack([u, v], axis=-1), axis=-1).max() > 10
    nearest = np.rint(measured).astype(int)
    a = straight[v, u].astype(float).ravel()
    b = bent[nearest[..., 1], nearest[..., 0]].astype(float).ravel()
    assert np.corrcoef(a, b)[0, 1] > 0.9
    assert np.corrcoef(a, bent[v, u].astype(float).ravel())[0, 1] < 0.5


def test_views(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    shown = {}
    for view in ("same", "valid", "all"):
        done = rdstitch("undistort", frames[0], "--lambda", "-0.2", "-o", tmp_path / view, "--view", view)
        assert done.status == 0
        shown[view] = read_image(tmp_path / view / frames[0].name)
    sizes = {view: np.array(picture.pixels.shape[:2]) for view, picture in shown.items()}
    assert sizes["same"].tolist() == [300, 400]
    # Without its barrel distortion a picture is larger everywhere, and its corners reach out farthest.
    assert (sizes["same"] < sizes["valid"]).all()
    assert (sizes["valid"] < sizes["all"]).all()
    assert shown["valid"].alpha is None
    assert shown["all"].alpha is not None


def test_refuses_no_lens_and_two_lenses(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    assert rdstitch("undistort", frames[0], "-o", tmp_path / "new").status == 2
    Camera((400, 300), distortion=-0.1).save(tmp_path / "camera.json")
    both = ("--lambda", "-0.1", "--camera", tmp_path / "camera.json")
    assert rdstitch("undistort", frames[0], "-o", tmp_path / "new", *both).status == 2
    assert not (tmp_path / "new").exists()


def test_refuses_to_write_over_its_input(rdstitch: Run, tmp_path: Path, frames: list[Path]) -> None:
    own = tmp_path / "own.png"
    own.write_bytes(frames[0].read_bytes())
    done = rdstitch("undistort", own, "--lambda", "-0.1", "-o", tmp_path, "--overwrite")
    assert done.status == 6
    assert str(own) in done.line
    assert own.read_bytes() == frames[0].read_bytes()


def test_own_outputs_and_damaged_pictures_are_named(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    with Image.open(frames[0]) as image:
        image.convert("RGB").save(pictures / "good.jpg", quality=95)
        image.convert("RGB").save(pictures / "damaged.jpg", quality=95)
    data = bytearray((pictures / "damaged.jpg").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(range(100, 140))
    (pictures / "damaged.jpg").write_bytes(bytes(data))
    assert rdstitch("pano", *frames[:2], "-o", pictures / "mosaic.png", *FAST).status == 0
    done = rdstitch("undistort", pictures, "--lambda", "-0.1", "-o", tmp_path / "straight")
    assert done.status == 0
    assert "mosaic.png" in done.err
    assert "damaged.jpg: is damaged" in done.err
    assert sorted(path.name for path in (tmp_path / "straight").iterdir()) == ["damaged.jpg", "good.jpg"]
