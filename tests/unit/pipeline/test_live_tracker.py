"""``rdstitch.Tracker``: metric poses of frames as they come, and the reason where there is none."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import rdstitch
from examples.odometry import main
from rdstitch.synthetic import Sequence
from tests.floor_drives import DISTORTION, floor_drive, true_path

HEIGHT = 0.8


@pytest.fixture(scope="module")
def drive() -> Sequence:
    return floor_drive("turn", 12, seed=3, size=(320, 240), overlap=0.6)


def _tracker() -> rdstitch.Tracker:
    return rdstitch.Tracker(rdstitch.StitchOptions(distortion=DISTORTION, focal=256.0), rdstitch.FollowedPoses(HEIGHT))


def test_metric_poses_near_the_truth_and_reasons_for_the_first_frames(drive: Sequence) -> None:
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
    start, turn = truth.position[0], np.exp(1j * truth.yaw[0])
    for number, pose in poses.items():
        x, y = truth.position[number] - start
        expected = turn * complex(x, y) * HEIGHT  # the axes of the first frame
        found = complex(pose.position[0], -pose.position[1])
        assert abs(found - expected) < 0.02 * HEIGHT + 0.02 * abs(expected)
        assert pose.position[2] == pytest.approx(HEIGHT * truth.height[number], rel=0.02)


def test_a_frame_that_shows_nothing_known_says_so(drive: Sequence) -> None:
    tracker = _tracker()
    for frame in drive.frames()[:8]:
        tracker.add(frame)
    lost = tracker.add(np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8))
    assert not lost
    assert lost.position is None
    assert lost.reason == "no keyframe shows what it shows"
    assert math.isnan(lost.timestamp)


def test_what_cannot_be_read_is_a_pose_without_a_place(tmp_path: Path) -> None:
    (tmp_path / "broken.png").write_bytes(b"no image")
    pose = _tracker().add(tmp_path / "broken.png")
    assert "not an image in a supported format" in pose.reason
    assert not pose


def test_the_example_prints_odometry(drive: Sequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive.write(tmp_path)
    main([str(tmp_path), "--height", "0.8"])
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines
    # The focal length is a guess, and the height goes with it.
    assert lines[-1]["pose"]["pose"]["position"]["z"] == pytest.approx(0.8, rel=0.1)
    assert len(lines[-1]["pose"]["covariance"]) == 36
    assert lines[-1]["header"]["frame_id"] == "odom_0"
