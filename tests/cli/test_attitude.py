"""``--attitude``: a gimbal's or IMU's tilt of every image, exact or nearly so, from a table or from XMP."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import rdstitch
from examples.worlds.drone_xmp import euler_angles, xmp_of
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.exif_orientation import turning_matrix
from rdstitch.geometry.planar_motion import turned_tilt
from rdstitch.synthetic import Photometry, RenderedSequence, grid_poses, ground, sequence_over
from tests.cli.running import CACHED, Run
from tests.sampled import sampled

LENS = Camera((400, 300), -0.2, focal=380.0)


@pytest.fixture(scope="module")
def windy() -> RenderedSequence:
    """A drone that tilts by another few degrees for each of six images."""
    poses = grid_poses(LENS, 3, 2, overlap=0.5, yaw=0.1, seed=4).shaken(seed=5, tilt=np.radians(4.0))
    return sequence_over(
        lambda size: ground(size, 4), LENS, poses, photometry=Photometry(noise=0.01), seed=4, margin=80
    )


def _table(sequence: RenderedSequence, paths: list[Path], error: float) -> str:
    tilt = np.degrees(sequence.poses.tilt[: len(paths)]) + np.random.default_rng(1).normal(
        scale=error, size=(len(paths), 2)
    )
    rows = [f"{path.name},{psi:.6f},{theta:.6f},50" for path, (psi, theta) in zip(paths, tilt, strict=True)]
    return "\n".join(["name,psi,theta,altitude", *rows])


def _with_xmp(sequence: RenderedSequence, folder: Path, source: str) -> list[Path]:
    """The images as JPEG files that tell the true attitudes in one maker's words."""
    paths = []
    for index in range(len(sequence)):
        xmp = xmp_of(source, *euler_angles(source, sequence.from_plane(index)[:, :2], north=0.7))
        paths.append(folder / f"drone_{index}.jpg")
        Image.fromarray(sequence.frame(index)).save(paths[-1], quality=95, xmp=xmp.encode())
    return paths


UPRIGHT, TURNED = (1, 1, 1, 1, 1, 1), (1, 6, 3, 8, 6, 1)  # by EXIF


@pytest.mark.parametrize(
    ("error", "std", "orientations"), sampled([(0.3, np.radians(0.3), UPRIGHT), (0.0, 0.0, TURNED)])
)
def test_measured_tilts_are_used_as_those_of_the_camera_whatever_exif_turns(
    windy: RenderedSequence, tmp_path: Path, error: float, std: float, orientations: tuple[int, ...]
) -> None:
    paths = windy.write(tmp_path)
    (tmp_path / "imu.csv").write_text(_table(windy, paths, error))
    for path, orientation in zip(paths, orientations, strict=True):
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.open(path).save(path, exif=exif)
    options = rdstitch.StitchOptions(
        attitude=tmp_path / "imu.csv", attitude_std=std, focal=LENS.focal, workers=1, model="auto"
    )
    trajectory, registration = rdstitch.trajectory(paths, options=options)
    assert registration.alignment.used.all()
    assert registration.alignment.model != "homography"
    assert abs(registration.alignment.distortion - LENS.distortion) < 0.005
    true = zip(windy.poses.tilt.tolist(), orientations, strict=True)
    upright = [turned_tilt((psi, theta), turning_matrix(orientation)) for (psi, theta), orientation in true]
    difference = np.degrees(registration.alignment.poses.tilt - upright)
    assert np.abs(difference).max() < (0.01 if std == 0.0 else 1.0)
    assert len(trajectory.position) == len(paths)
    turn = np.degrees(trajectory.yaw - windy.poses.yaw)
    assert np.abs(np.remainder(turn - turn[0] + 180.0, 360.0) - 180.0).max() < (0.2 if std == 0.0 else 1.0)


@pytest.mark.parametrize(("source", "std"), sampled([("dji-gimbal", 0.0), ("pix4d-camera", np.radians(1.0))]))
def test_drones_write_tilts_into_their_images(windy: RenderedSequence, tmp_path: Path, source: str, std: float) -> None:
    paths = _with_xmp(windy, tmp_path, source)
    options = rdstitch.StitchOptions(attitude="xmp", attitude_std=std, focal=LENS.focal, workers=1)
    _, registration = rdstitch.trajectory(paths, options=options)
    alignment = registration.alignment
    assert alignment.used.all()
    assert abs(alignment.distortion - LENS.distortion) < 0.005
    assert np.degrees(np.abs(alignment.poses.tilt - windy.poses.tilt)).max() < (0.01 if std == 0.0 else 1.0)


def test_images_without_attitude_are_named(
    rdstitch: Run, windy: RenderedSequence, frames: list[Path], tmp_path: Path
) -> None:
    paths = _with_xmp(windy, tmp_path, "parrot-camera")[:2]
    arguments = ("calibrate", "--attitude", "xmp", "-o", tmp_path / "camera.json", *CACHED)
    rdstitch(*arguments, *paths)
    (tmp_path / "camera.json").unlink()
    some = rdstitch(*arguments, *paths, frames[0], status=3)
    none = rdstitch(*arguments, *windy.write(tmp_path), status=3)
    assert f" {frames[0].name}: no attitude" in some.line
    assert paths[0].name not in some.line
    assert "frame_0002.png, …: no attitude" in none.line
    assert not (tmp_path / "camera.json").exists()


def test_cameras_that_look_at_the_horizon_are_refused(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    for frame in frames:
        xmp = xmp_of("dji-gimbal", 10.0, -4.0, 0.0).encode()
        Image.open(frame).save(tmp_path / f"{frame.stem}.jpg", xmp=xmp)
    done = rdstitch("calibrate", tmp_path, "--attitude", "xmp", "-o", tmp_path / "camera.json", status=3)
    assert "86 degrees away from straight down" in done.line


def test_pairs_get_one_tilt_an_image(windy: RenderedSequence, tmp_path: Path) -> None:
    paths = windy.write(tmp_path)[:2]
    (tmp_path / "imu.csv").write_text(_table(windy, paths, 0.0))
    options = rdstitch.StitchOptions(
        attitude=tmp_path / "imu.csv", attitude_std=0.0, focal=LENS.focal, solver="two_point", workers=1
    )
    registration = rdstitch.calibrate(paths, options)
    assert [pair.relation.solver for pair in registration.pairs] == ["two_point"]
    assert abs(registration.alignment.distortion - LENS.distortion) < 0.01
