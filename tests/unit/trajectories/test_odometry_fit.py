"""Wheel odometry: the scale of a path, poses of frames that show nothing, offline and live."""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rdstitch
from examples.worlds.floor_drives import DISTORTION, floor_drive, true_path
from rdstitch.errors import ArgumentError, InputError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.odometry import BodyPose, read_odometry
from rdstitch.synthetic import RenderedSequence
from rdstitch.tracking import TrackingResult
from rdstitch.trajectories.odometry_fit import OdometryFit, along_odometry, bridged, motions_of
from rdstitch.trajectories.trajectory import Trajectory

HEIGHT, LEVER, MOUNT = 0.42, 0.15 - 0.06j, np.exp(0.5j * np.pi)  # metres; the top of the image is ahead


def _bodies(path: Trajectory, slip: float, seed: int = 0) -> list[BodyPose]:
    """What wheels say of the body that carries a camera along a path in metres."""
    rng, yaw = np.random.default_rng(seed), path.yaw
    camera = path.position @ np.array([1.0, -1.0j]) * MOUNT
    body = camera - LEVER * np.exp(1j * yaw)
    steps = np.diff(body) * (1.0 + slip * rng.standard_normal(len(body) - 1))
    places = np.concatenate([[0.0], np.cumsum(steps)])
    return [BodyPose(place.real, place.imag, turn) for place, turn in zip(places, yaw.tolist(), strict=True)]


def _path(seed: int = 0) -> Trajectory:
    """In heights, with noise of a thousandth of a step."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0.0, 0.15, 40))
    ahead = np.stack([np.sin(-yaw), -np.cos(-yaw)], axis=1)
    position = np.cumsum(0.5 * ahead, axis=0)
    return Trajectory(np.arange(40), position - position[0], yaw - yaw[0], np.ones(40))


def test_the_scale_and_the_mount_are_found_as_well_as_it_says() -> None:
    errors = []
    for seed in range(20):
        path = _path(seed)
        metres = replace(path, position=path.position * HEIGHT)
        found = along_odometry(path, dict(enumerate(_bodies(metres, 0.02, seed))), keep_unit=False)
        assert found is not None
        scaled, fit = found
        errors.append((scaled.height[0] / HEIGHT - 1.0) / np.sqrt(fit.length_std**2 - 0.01**2))
        assert abs(fit.lever - LEVER) < 0.05
        assert fit.scale == pytest.approx(MOUNT, abs=0.05)
        assert 0.01 < fit.length_std < 0.03
    assert 0.3 < np.mean(np.square(errors)) < 2.5
    assert OdometryFit.of([]) is None


def test_motions_without_a_variance_count_alike() -> None:
    path = _path()
    bodies = _bodies(replace(path, position=path.position * HEIGHT), 0.02)
    places = (path.position @ np.array([1.0, -1.0j])).tolist()
    motions = motions_of(list(zip(places, path.yaw.tolist(), bodies, strict=True)))
    fit = OdometryFit.of([motion._replace(variance=0.0) for motion in motions])
    assert fit is not None
    assert abs(fit.scale) == pytest.approx(HEIGHT, rel=0.05)
    assert 0.01 < fit.length_std < 0.03


def _seen_and_stated(
    seed: int, seen: NDArray[np.intp], length_std: float, yaw_std: float, slip: float, turn_std: float
) -> tuple[Trajectory, Trajectory, dict[int, BodyPose]]:
    """A path in metres, what images say of some of its frames, in heights, and what wheels say.

    Each is as exact as stated, but for the size of the wheels, which is off by 1 %.
    """
    rng, place_std = np.random.default_rng(seed), 0.003
    true = _path(seed)
    count = len(true)
    metres = replace(true, position=HEIGHT * true.position, height=HEIGHT * true.height)
    body = metres.position @ [1.0, -1.0j] * MOUNT - LEVER * np.exp(1j * true.yaw)
    steps = np.diff(body) * np.exp(-1j * true.yaw[:-1]) + slip * (rng.normal(size=(count - 1, 2)) @ [1.0, 1.0j])
    turns = np.append(0.0, np.cumsum(np.diff(true.yaw) + turn_std * rng.normal(size=count - 1)))
    wheels = 1.0 + 0.01 * rng.normal()
    places = wheels * np.append(0.0, np.cumsum(steps * np.exp(1j * turns[:-1])))
    bodies = {
        k: BodyPose(place.real, place.imag, turn, slip**2 * (k + 1), turn_std**2 * (k + 1))
        for k, (place, turn) in enumerate(zip(places.tolist(), turns.tolist(), strict=True))
    }
    moves = (seen > 0).astype(float)  # all poses are relative to the first
    found = true.position[seen] + place_std * moves[:, None] * rng.normal(size=(len(seen), 2))
    found *= 1.0 + length_std * rng.normal()
    covariance = np.zeros((len(seen), 4, 4))
    covariance[:, :2, :2] = place_std**2 * np.eye(2) + length_std**2 * found[:, :, None] * found[:, None]
    covariance[:, 3, 3] = yaw_std**2
    covariance[0] = 0.0
    yaw = true.yaw[seen] + yaw_std * moves * rng.normal(size=len(seen))
    return metres, Trajectory(seen, found, yaw, true.height[seen], covariance=covariance, length_std=length_std), bodies


@pytest.mark.parametrize(
    ("keep_unit", "stated"),  # stated: of all lengths by images and of their yaw; of a step and a turn by the wheels
    [
        (False, (0.002, 0.03, 0.002, 0.0005)),
        (True, (0.03, 0.002, 0.002, 0.02)),
        (False, (0.03, 0.002, 0.01, 0.0005)),
        (True, (0.002, 0.01, 0.004, 0.002)),
    ],
)
@pytest.mark.parametrize("seen", [np.r_[0:20, 30:40], np.r_[0:30]], ids=["between", "after"])
def test_covariances_are_right_of_frames_with_texture_and_without(
    seen: NDArray[np.intp], keep_unit: bool, stated: tuple[float, float, float, float]
) -> None:
    squares, heights = [], []
    for seed in range(60):
        metres, shown, bodies = _seen_and_stated(seed, seen, *stated)
        found = along_odometry(shown, bodies, keep_unit=keep_unit)
        assert found is not None
        path, fit = found
        assert path.length_std == pytest.approx((shown if keep_unit else fit).length_std)
        assert path.frame.tolist() == list(range(40))
        assert path.covariance is not None
        unit = HEIGHT if keep_unit else 1.0
        off = np.column_stack([path.position - metres.position / unit, path.yaw - metres.yaw])[1:]
        known = path.covariance[1:][:, [[0], [1], [3]], [0, 1, 3]]
        squares.append(np.einsum("ni,ni->n", off, np.linalg.solve(known, off[..., None])[..., 0]) / 3.0)
        heights.append((path.height - metres.height / unit) ** 2 / np.maximum(path.covariance[:, 2, 2], 1e-12))
    of_each = np.mean(squares, axis=0)
    bridge = np.isin(np.arange(1, 40), seen, invert=True)
    assert 0.6 < of_each[bridge].mean() < 1.5
    assert 0.6 < of_each[~bridge].mean() < 1.5
    # Of a camera in metres by the wheels the images know the height as well as their lengths; else it is the unit.
    assert np.mean(heights) < 1e-6 if keep_unit else 0.6 < np.mean(heights) < 1.5


@pytest.mark.parametrize("keep_unit", [False, True])
def test_a_path_whose_lengths_are_not_known_has_covariances(*, keep_unit: bool) -> None:
    metres = _path()
    shown = replace(metres, covariance=np.tile(1e-4 * np.eye(4), (len(metres), 1, 1)))
    found = along_odometry(shown, dict(enumerate(_bodies(metres, 0.01))), keep_unit=keep_unit)
    assert found is not None
    assert found[0].covariance is not None
    assert np.isfinite(found[0].covariance).all()


def test_a_path_has_a_value_of_each_kind_a_frame() -> None:
    with pytest.raises(ArgumentError, match="a trajectory of 40 frames"):
        replace(_path(), name=("a.png", "b.png"))


@pytest.fixture(scope="module")
def drive() -> RenderedSequence:
    return floor_drive("turn", 16, seed=3, size=(320, 240), overlap=0.6)


def _metres(drive: RenderedSequence) -> Trajectory:
    path = true_path(drive)
    turn, first = np.exp(1j * path.yaw[0]), path.position[0]
    places = turn * ((path.position - first) @ [1.0, 1.0j]) * HEIGHT / path.height[0]
    return replace(path, position=np.stack([places.real, places.imag], axis=1), yaw=path.yaw - path.yaw[0])


def _files(drive: RenderedSequence, folder: Path) -> dict[str, Any]:
    """Odometry at twice the rate of the frames, and times of these."""
    bodies, times = _bodies(_metres(drive), 0.01), np.arange(len(drive)) * 0.1
    between = [BodyPose(*np.mean([a, b], axis=0)) for a, b in pairwise(bodies)]
    rows = sorted([*zip(times, bodies, strict=True), *zip(times[:-1] + 0.05, between, strict=True)])
    text = "".join(f"{t:.3f},{b.x:.6f},{b.y:.6f},{np.degrees(b.yaw):.6f}\n" for t, b in rows)
    (folder / "odom.csv").write_text(f"timestamp,x,y,yaw_deg\n{text}", encoding="utf-8")
    (folder / "times.txt").write_text("".join(f"{time}\n" for time in times), encoding="utf-8")
    return {"odometry": folder / "odom.csv", "timestamps": folder / "times.txt"}


CAMERA = Camera((320, 240), DISTORTION, focal=256.0, focal_source="option")


def test_offline_and_live_give_metres_and_bridge_what_shows_nothing(drive: RenderedSequence, tmp_path: Path) -> None:
    images = list(drive.frames())
    for k in (9, 10):
        images[k] = np.full_like(images[k], 120)
    options = rdstitch.StitchOptions(camera=CAMERA, tilt=(np.radians(3.0), np.radians(-2.0)), **_files(drive, tmp_path))
    path, registration = rdstitch.trajectory(images, options=options)
    assert path.frame.tolist() == list(range(16))
    assert path.height[0] == pytest.approx(HEIGHT, rel=0.03)
    assert np.abs(path.position - _metres(drive).position).max() < 0.06 * HEIGHT + 0.02
    assert any("placed by the odometry alone: image_0009" in message.text for message in registration.messages)

    tracker, poses = rdstitch.Tracker(options, rdstitch.FollowedPoses(frame="camera")), dict[int, rdstitch.Pose]()
    for k, image in enumerate(images):
        pose = tracker.add(image, 0.1 * k)
        poses |= {known.number: known for known in (*tracker.revised, pose)}
    assert all(poses.values())
    assert {pose.map for pose in poses.values()} == {0}
    late = [k for k in poses if k > 6]
    places = np.array([poses[k].position[:2] for k in late])
    assert np.abs(places - _metres(drive).position[late]).max() < 0.08 * HEIGHT + 0.03
    assert 0.01 < poses[15].length_std < 0.03


def test_which_lengths_are_uncertain_is_said_of_the_path_that_was_made(drive: RenderedSequence, tmp_path: Path) -> None:
    """Straight down, images do not show the focal length: by wheels the path is known all the same, its height not."""
    images = list(drive.frames())[:8]
    files = _files(drive, tmp_path)
    (tmp_path / "times.txt").write_text("".join(f"{0.1 * k}\n" for k in range(8)), encoding="utf-8")
    options = rdstitch.StitchOptions(distortion=DISTORTION, model="similarity", **files)
    for height, lengths in ((None, "the camera is at"), (HEIGHT, "all lengths may be off together")):
        path, registration = rdstitch.trajectory(images, options=options, height=height)
        texts = [text for text in map(str, registration.messages) if "lengths" in text]
        assert [lengths in text for text in texts] == [True]
        by_images = registration.alignment.length_std
        assert by_images > 0.05
        assert path.length_std == (by_images if height else pytest.approx(0.015, abs=0.01))
    bodies = _bodies(_metres(drive), 0.5)
    rows = "".join(f"{0.1 * k:.1f},{b.x},{b.y},{np.degrees(b.yaw)}\n" for k, b in enumerate(bodies))
    files["odometry"].write_text(f"timestamp,x,y,yaw_deg\n{rows}", encoding="utf-8")
    path, registration = rdstitch.trajectory(images, options=options)
    (warning,) = (one for one in registration.messages if "lengths are those of the odometry" in one.text)
    assert (warning.severity, path.length_std > 0.05) == ("warning", True)
    assert warning.text.endswith("or give --height")


def test_a_height_of_one_is_a_height() -> None:
    known = TrackingResult(0, None, DISTORTION, 0.0, True, 0, True, 0, length_std=0.01, unit=0.3, unit_std=0.05)
    for given, length, std in ((None, 0.3, 0.05), (1.0, 1.0, 0.01)):
        pose = rdstitch.Pose("", 0, 0.0, known, poses=rdstitch.FollowedPoses(given))
        assert (pose.unit, pose.length_std) == (length, std)


def test_odometry_is_read_from_tum_and_refused_by_line(tmp_path: Path) -> None:
    file = tmp_path / "odom.tum"
    file.write_text("# time\n1 0 0 0 0 0 0 1\n2 1 0.5 0 0 0 0.70710678 0.70710678\n", encoding="utf-8")
    body = read_odometry(file).at(1.5)
    assert body is not None
    assert body[:3] == pytest.approx((0.5, 0.25, np.pi / 4))
    assert read_odometry(file).at(2.5) is None
    file.write_text("1 0 0 0 0 0 0 1\n2 1 0.5 0 0 0 one 1\n", encoding="utf-8")
    with pytest.raises(InputError, match="line 2"):
        read_odometry(file)
    table = "timestamp,x,y,qx,qy,qz,qw\n1,0,0,0,0,0,1\n2,1,0,"
    for text in ("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 1 1\n", f"{table}0,0,1,1\n"):
        file.write_text(text, encoding="utf-8")
        where = f"line {len(text.splitlines())}: 0, 0, 1, 1 is not a unit quaternion"
        with pytest.raises(InputError, match=where):
            read_odometry(file)
    file.write_text("timestamp (m),x (s),y (deg),yaw (m)\n1,0,0,0\n2,1,0,0\n", encoding="utf-8")
    with pytest.raises(InputError, match=re.escape("the column 'timestamp (m)' has a unit that is not known here")):
        read_odometry(file)
    file.write_text("timestamp (s),x (m),y (m),yaw (rad)\n1,0,0,0\n2,1,0,2\n", encoding="utf-8")
    assert read_odometry(file).at(1.5)[:3] == pytest.approx((0.5, 0.0, 1.0))
    # Eight columns are a table where there are commas.
    file.write_text("# timestamp,x,y,z,qx,qy,qz,qw\n1 ,0 ,0 ,0 ,0 ,0 ,0 ,1\n2 ,1 ,0 ,0 ,0 ,0 ,0 ,1\n", encoding="utf-8")
    assert read_odometry(file).at(1.5)[:3] == pytest.approx((0.5, 0.0, 0.0))


def test_turns_by_more_than_half_a_circle_are_bridged_the_way_they_were_made() -> None:
    yaw = np.radians([0.0, 67.5, 135.0, 202.5, 270.0])
    bodies = {k: BodyPose(0.0, 0.0, turn) for k, turn in enumerate(yaw.tolist())}
    for last in (yaw[-1], yaw[-1] - 2.0 * np.pi):  # images alone know it up to whole turns
        path = Trajectory(np.array([0, 4]), np.zeros((2, 2)), np.array([0.0, last]), np.ones(2))
        np.testing.assert_allclose(
            bridged(path, bodies, OdometryFit(1.0, 0.0, 1.0, np.zeros((2, 2), dtype=np.complex128))).yaw, yaw
        )
