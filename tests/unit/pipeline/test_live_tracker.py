"""``rdstitch.Tracker``: metric poses of frames as they come, and the reason where there is none."""

import math
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import rdstitch
from examples.benchmarks.robot import HEIGHT as DRIVE_HEIGHT
from examples.benchmarks.robot import swaying
from examples.worlds.floor_drives import DISTORTION, floor_drive, true_path
from examples.worlds.paths import drive_poses
from rdstitch.alignment import AlignmentOptions
from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError, ImpossibleCameraError, InputError, LimitError
from rdstitch.features import detect, match
from rdstitch.features.prepared_image import View, prepare
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.frame import Frame
from rdstitch.robust import EstimationOptions
from rdstitch.synthetic import RenderedSequence, ground, sequence_over
from rdstitch.tracking import FrameTracker, TrackingResult
from rdstitch.tracking.tracking_state import TrackingState

HEIGHT = 0.8


@pytest.fixture(scope="module")
def drive() -> RenderedSequence:
    return floor_drive("turn", 12, seed=3, size=(320, 240), overlap=0.6)


def _tracker() -> rdstitch.Tracker:
    return rdstitch.Tracker(rdstitch.StitchOptions(distortion=DISTORTION, focal=256.0), rdstitch.FollowedPoses(HEIGHT))


@pytest.mark.parametrize("table", ["timestamps", "positions", "gcp", "check_points"])
def test_a_file_that_does_not_exist_is_refused_before_the_first_frame(table: str, tmp_path: Path) -> None:
    file = tmp_path / "table.csv"
    known: dict[str, Any] = {table: file}
    options = rdstitch.StitchOptions(**known)
    with pytest.raises(InputError, match=r"table\.csv: no such file"):
        rdstitch.Tracker(options)
    file.touch()  # its lines come as the frames do
    rdstitch.Tracker(options)


def test_metric_poses_near_the_truth_and_reasons_for_the_first_frames(drive: RenderedSequence) -> None:
    tracker = _tracker()
    poses: dict[int, rdstitch.Pose] = {}
    for number, frame in enumerate(drive.frames()):
        pose = tracker.add(frame, 0.1 * number)
        assert pose.number == number
        assert pose.timestamp == pytest.approx(0.1 * number)
        assert bool(pose) == (pose.position is not None) == (pose.yaw is not None) == (pose.reason == "")
        poses |= {known.number: known for known in (*tracker.revised, pose)}
    assert all(poses.values())
    truth = true_path(drive)
    far = HEIGHT * np.linalg.norm(truth.position - truth.position[0], axis=1)[[*poses]]
    assert (np.linalg.norm(_errors(poses, drive), axis=1) < 0.02 * HEIGHT + 0.02 * far).all()
    heights = [pose.position[2] for pose in poses.values()]
    np.testing.assert_allclose(heights, HEIGHT * truth.height[[*poses]], rtol=0.02)


def test_what_cannot_be_read_is_a_pose_without_a_place(tmp_path: Path) -> None:
    (tmp_path / "broken.png").write_bytes(b"no image")
    pose = _tracker().add(tmp_path / "broken.png")
    assert "not an image in a supported format" in pose.reason
    assert not pose


def test_the_reason_is_that_of_the_tracking() -> None:
    tracked = TrackingResult(state=TrackingState.NO_TEXTURE)
    assert rdstitch.Pose("a.jpg", 1, 0.0, tracked).reason == "no floor texture"


@pytest.mark.parametrize(
    "measured",
    [
        {"timestamp": "x"},
        {"timestamp": np.datetime64("2020-01-01")},
        {"attitude": (0.1, 0.2, 0.3)},
        {"attitude": 0.1},
        {"odometry": (1.0, 2.0)},
    ],
)
def test_what_no_sensor_measures_is_refused_and_no_frame_is_counted(measured: dict[str, Any]) -> None:
    tracker, image = _tracker(), np.zeros((240, 320), np.uint8)
    with pytest.raises(ArgumentError, match=f"{next(iter(measured))} must be"):
        tracker.add(image, **measured)
    assert tracker.add(image).number == 0


CAMERA = Camera((320, 240), DISTORTION, focal=256.0, focal_source="option")
TILT = (math.radians(3.0), math.radians(-2.0))


def _all_poses(tracker: rdstitch.Tracker, images: Iterable[NDArray[np.uint8]]) -> dict[int, rdstitch.Pose]:
    """The last pose of each frame."""
    poses: dict[int, rdstitch.Pose] = {}
    for image in images:
        pose = tracker.add(image)
        poses |= {known.number: known for known in (*tracker.revised, pose)}
    return poses


def _errors(poses: dict[int, rdstitch.Pose], drive: RenderedSequence) -> FloatArray:
    """How far (N, 2) positions are from the truth, metres, in the axes of the first image."""
    truth = true_path(drive)
    turn = np.exp(1j * truth.yaw[0])
    places = turn * ((truth.position - truth.position[0]) @ [1.0, 1.0j]) * HEIGHT
    errors = np.array([complex(pose.position[0], -pose.position[1]) - places[k] for k, pose in poses.items() if pose])
    return np.stack([errors.real, errors.imag], axis=1)


def test_with_lens_and_tilt_the_second_frame_has_a_pose_and_errors_are_as_large_as_they_say(
    drive: RenderedSequence,
) -> None:
    tracker = rdstitch.Tracker(rdstitch.StitchOptions(camera=CAMERA, tilt=TILT), rdstitch.FollowedPoses(HEIGHT))
    first = tracker.add(drive.frame(0))
    assert (bool(first), first.reason) == (False, "first frame")
    second = tracker.add(drive.frame(1))
    assert second
    assert [pose.number for pose in tracker.revised] == [0]
    poses = _all_poses(tracker, drive.frames()[2:])
    assert all(poses.values())
    # Lengths are as good as the focal length, whose standard deviation is 1 %.
    far = max(float(np.hypot(*pose.position[:2])) for pose in poses.values())
    assert np.abs(_errors(poses, drive)).max() < 0.005 * HEIGHT + 0.01 * far
    for pose in [pose for pose in poses.values() if pose.number]:  # the first is matched with none
        assert pose.covariance.shape == (4, 4)
        assert (np.linalg.eigvalsh(pose.covariance)[1:] > 0.0).all()
        assert pose.ros_covariance[5, 5] == pytest.approx(pose.covariance[3, 3])
        assert 0.5 < pose.quality <= 1.0
        assert pose.map == 0
    # A focal length that was given is only as good as what the images have confirmed of it.
    stated = second.length_std, poses[11].length_std
    assert 0.02 < stated[0] < 0.1
    assert 0.002 < stated[1] < 0.012
    for pose in poses.values():
        x, y, _ = pose.position
        assert np.trace(pose.covariance[:2, :2]) > (0.99 * pose.length_std * math.hypot(x, y)) ** 2


def test_what_stays_in_the_image_is_no_floor(drive: RenderedSequence) -> None:
    part = np.kron(np.random.default_rng(1).integers(0, 255, (6, 32, 3)), np.ones((10, 10, 1))).astype(np.uint8)
    tracker = rdstitch.Tracker(rdstitch.StitchOptions(camera=CAMERA), rdstitch.FollowedPoses(HEIGHT))
    poses = _all_poses(tracker, (np.concatenate([image[:180], part]) for image in drive.frames()))
    assert all(poses.values())
    assert np.abs(_errors(poses, drive)).max() < 0.03 * HEIGHT


def test_measured_attitudes_are_used(tmp_path: Path) -> None:
    lens = CAMERA
    tilts = [(0.06 * math.sin(k), 0.05 * math.cos(2.0 * k)) for k in range(8)]
    swaying = replace(drive_poses(lens, "line", 8, overlap=0.6), tilt=np.array(tilts))
    images = sequence_over(partial(ground, seed=1), lens, swaying).frames()
    options = rdstitch.StitchOptions(camera=CAMERA, tilt=(0.0, 0.0), attitude_std=0.0)
    tracker = rdstitch.Tracker(options, rdstitch.FollowedPoses(HEIGHT))
    for nothing in ((math.nan, 0.0), (0.0, math.nan)):
        assert "not known" in tracker.add(images[0], attitude=nothing).reason
    nothing = (3.0, -2.0)  # degrees
    assert "psi and theta must lie between" in tracker.add(images[0], attitude=nothing).reason
    found = [tracker.add(image, 0.1 * k, attitude=np.array(tilts[k])) for k, image in enumerate(images[:4])]
    assert "psi and theta" in tracker.add(images[3], attitude=nothing, odometry=(math.nan, 0.0, 0.0)).reason
    found += [tracker.add(image, 0.1 * k, attitude=tilts[k]) for k, image in enumerate(images[4:], 4)]
    times = "".join(f"{0.05 * k},0,0\n" for k in range(3))
    assert all(found[1:])
    steps = np.diff([(0.0, 0.0), *(pose.position[:2] for pose in found[1:])], axis=0)
    assert np.abs(steps - steps.mean(axis=0)).max() < 0.01 * HEIGHT
    table = tmp_path / "attitude.csv"
    table.write_text("timestamp,psi,theta\n" + times, encoding="utf-8")
    late = rdstitch.Tracker(rdstitch.StitchOptions(camera=CAMERA, attitude=table))
    assert "attitude.csv" in late.add(images[0], 5.0).reason
    with pytest.raises(InputError, match="no such file"):
        rdstitch.Tracker(rdstitch.StitchOptions(attitude=tmp_path / "missing.csv"))


def test_late_attitudes_are_found_and_positions_are_as_uncertain_as_they_say(tmp_path: Path) -> None:
    drive = swaying(CAMERA, replace(CAMERA, focal_std=0.002 * CAMERA.focal), 16, seed=5)
    files = {name: tmp_path / f"{name}.csv" for name in drive.files}
    for name, content in drive.files.items():
        files[name].write_text(content, encoding="utf-8")
    options = rdstitch.StitchOptions(**(drive.told | files))
    tracker = rdstitch.Tracker(options, rdstitch.FollowedPoses(DRIVE_HEIGHT, "camera"), patient=True)
    last = _rows(tracker, drive.images)
    assert [message.code for message in tracker.messages] == ["attitudes-late"]
    np.testing.assert_allclose(last[0].position[:2], 0.0, atol=1e-9)
    for number, pose in enumerate(last[1:], start=1):
        off = complex(*pose.position[:2]) - drive.places[number]
        error = np.array([off.real, off.imag])
        assert error @ np.linalg.solve(pose.covariance[:2, :2], error) < 3.5**2


def _rows(tracker: rdstitch.Tracker, images: Iterable[NDArray[np.uint8]]) -> list[rdstitch.Pose]:
    """The last pose of each frame when all have come."""
    poses = _all_poses(tracker, images)
    poses |= {known.number: known for known in tracker.finish()}
    return [poses[number] for number in sorted(poses)]


@pytest.mark.parametrize("late", [0, 3])  # keyframes by which alignments come later than planned
def test_a_focal_length_that_the_images_contradict_is_replaced_and_lengths_are_as_uncertain_until_then(
    late: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rdstitch.tracking.map_refinement._FIRST_DELAY", 1 + late)
    monkeypatch.setattr("rdstitch.tracking.map_refinement._DELAY", 8 + late)
    lens = Camera((320, 240), DISTORTION, focal=256.0)
    poses = drive_poses(lens, "turn", 24, overlap=0.75, tilt=(0.12, -0.07))
    images = sequence_over(partial(ground, seed=3), lens, poses).frames()
    told = replace(CAMERA, focal=1.1 * 256.0)
    options = rdstitch.StitchOptions(camera=told, workers=1)
    tracker = rdstitch.Tracker(options, rdstitch.FollowedPoses(HEIGHT, "camera"), patient=True)
    early = tracker.add(images[0]), tracker.add(images[1]), tracker.add(images[2])
    last = _rows(tracker, images[3:])
    turn, first = np.exp(1j * poses.yaw[0]), poses.position[0]
    truth = turn * ((poses.position - first) @ [1.0, 1.0j]) * HEIGHT / poses.height[0]
    for pose in (*early, *last):
        if pose:
            off = abs(complex(*pose.position[:2]) - truth[pose.number])
            assert off < 4.0 * math.sqrt(np.trace(pose.covariance[:2, :2])) + 1e-3
    assert any(message.code == "focal-contradicted" for message in tracker.messages)
    assert last[-1].length_std < 0.02


def test_a_short_drive_without_a_camera_has_all_its_poses_at_the_end(drive: RenderedSequence) -> None:
    poses = _rows(rdstitch.Tracker(rdstitch.StitchOptions()), drive.frames()[:4])
    assert len(poses) == 4
    assert all(poses)


def test_after_a_jump_it_finds_its_place_in_the_map(drive: RenderedSequence) -> None:
    tracker = rdstitch.Tracker(rdstitch.StitchOptions(camera=CAMERA, tilt=TILT), rdstitch.FollowedPoses(HEIGHT))
    images = drive.frames()
    poses = _all_poses(tracker, [*images, np.full_like(images[0], 120), images[1], images[2]])
    assert (bool(poses[12]), poses[12].position, poses[12].reason) == (False, None, "no floor texture")
    assert math.isnan(poses[12].timestamp)
    for number, shown in ((13, 1), (14, 2)):
        assert poses[number].map == 0
        assert np.linalg.norm(np.subtract(poses[number].position, poses[shown].position)) < 0.005 * HEIGHT


# LimitError where its worker was killed, RuntimeError of a singular matrix.
@pytest.mark.parametrize("error", [ImpossibleCameraError, LimitError, RuntimeError])
def test_an_alignment_that_fails_is_survived(
    error: type[Exception], drive: RenderedSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise error("what went wrong")

    monkeypatch.setattr("rdstitch.tracking.map_refinement.align", fails)
    monkeypatch.setattr("rdstitch.tracking.map_refinement._DELAY", 1)
    known = EstimationOptions(distortion=DISTORTION), AlignmentOptions(tilt=TILT, lens_known=True)
    tracker = FrameTracker(*known, lambda image: detect(image.grey), match, ThreadPoolExecutor(1))
    for image in drive.frames():
        *_, last = tracker.add(prepare(View(image), None), CAMERA)
    assert last.pose is not None
    assert "what went wrong" in tracker.messages[0].text


def test_masks_lie_in_folders_as_their_frames_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the folder of masks is listed once a frame."""
    for kind in ("frames", "masks"):
        for folder in ("east", "west"):
            (tmp_path / kind / folder).mkdir(parents=True)
            cv2.imwrite(str(tmp_path / kind / folder / "f.png"), np.full((30, 40), 255, np.uint8))
    tracker = rdstitch.Tracker(rdstitch.StitchOptions(mask=tmp_path / "masks"))
    listed = Mock(side_effect=os.walk)
    monkeypatch.setattr("rdstitch.inputs.masks.os.walk", listed)
    source = tracker.read(Frame(tmp_path / "frames" / "east" / "f.png", label="east/f.png")).source
    assert source is not None
    assert source.mask is not None
    assert source.mask.path == tmp_path / "masks" / "east" / "f.png"
    listed.assert_called_once()
