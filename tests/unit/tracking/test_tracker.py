"""Frames placed one after the other: near the truth, in bounded memory, and never silently on the wrong map."""

import math
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from examples.judging.trajectories import compare_trajectories
from rdstitch.alignment.trajectory import Trajectory
from rdstitch.camera import Camera
from rdstitch.features import FeatureOptions, Features, detect, match
from rdstitch.features.prepared_image import View, prepare
from rdstitch.inputs.corner_flow import CornerFlow, fitted_affine
from rdstitch.robust import EstimationOptions
from rdstitch.synthetic import Sequence, blank, drive_poses, sequence_over
from rdstitch.tracking import Tracked, Tracker, TrackingOptions
from rdstitch.tracking import tracker as module
from tests.floor_drives import floor_drive, true_path

SIZE = (320, 240)
DISTORTION = -0.25
MASK = np.arange(240)[:, None].repeat(320, axis=1) < 190


def _drive(count: int, overlap: float = 0.7, path: str = "turn") -> Sequence:
    lens = Camera(SIZE, DISTORTION, focal=256.0)
    return sequence_over(blank, lens, drive_poses(lens, path, count, overlap=overlap, tilt=(0.05, -0.03)))


def _features(sequence: Sequence, world: int = 0) -> list[Features]:
    """What a detector would find: points of the plane, each with a descriptor of its own, off by 0.2 pixels."""
    rng = np.random.default_rng(world)
    width, height = sequence.texture.size
    places = rng.uniform(0.0, (width, height), (width * height // 500, 2))
    words = rng.normal(size=(len(places), 32)).astype(np.float32)
    frames = []
    for index in range(len(sequence)):
        seen = sequence.to_image(index, places)
        inside = np.isfinite(seen).all(axis=1) & (seen > 0.0).all(axis=1) & (seen < np.array(SIZE) - 1.0).all(axis=1)
        points = seen[inside] + rng.normal(0.0, 0.2, (int(inside.sum()), 2))
        ones = np.ones(len(points))
        frames.append(Features(points, words[inside], ones, 0.0 * ones, ones, None, "made up", SIZE))
    return frames


def _tracker(distortion: float | None = None) -> Tracker:
    return Tracker(
        TrackingOptions(EstimationOptions(distortion=distortion, select_below=50)), partial(match, ratio=0.8)
    )


def _path(results: list[Tracked]) -> Trajectory:
    """The last pose given of each frame."""
    poses = {result.number: pose for result in results if (pose := result.pose) is not None}
    numbers = sorted(poses)
    places = np.array([(poses[k].x, poses[k].y) for k in numbers])
    yaw, height = (np.array([getattr(poses[k], name) for k in numbers]) for name in ("yaw", "height"))
    return Trajectory(np.array(numbers), places, yaw, height)


@pytest.fixture(scope="module")
def drive() -> Sequence:
    return _drive(30)


@pytest.fixture(scope="module")
def tracked(drive: Sequence) -> list[Tracked]:
    """What becomes of its frames where nothing is known."""
    tracker = _tracker()
    return [result for frame in _features(drive) for result in tracker.add(frame, Camera(SIZE))]


def _check(results: list[Tracked], sequence: Sequence) -> None:
    """Near the truth; every frame but those before the first alignment has a place when it comes."""
    error = compare_trajectories(_path(results), true_path(sequence))
    assert error.drift < 0.004
    assert error.rotation < math.radians(0.1)
    assert all(result.placement is not None for result in results if result.number >= 12)


def test_the_path_and_lambda_come_near_thetrue_path(tracked: list[Tracked], drive: Sequence) -> None:
    _check(tracked, drive)
    assert abs(tracked[-1].distortion - DISTORTION) < 0.003


def test_a_lambda_that_is_given_is_kept(drive: Sequence) -> None:
    tracker = _tracker(DISTORTION)
    results = [result for frame in _features(drive)[:14] for result in tracker.add(frame, Camera(SIZE))]
    _check(results, drive)
    assert {(result.distortion, result.distortion_std) for result in results} == {(DISTORTION, 0.0)}
    assert all(result.distortion_known for result in results)


def test_lambda_becomes_surer_until_it_is_known(tracked: list[Tracked]) -> None:
    results = [result for result in tracked if not result.revised]
    stds = [result.distortion_std for result in results]
    assert stds[0] == math.inf
    assert 0.0 < stds[-1] < 0.5 * stds[3]
    first = [result.distortion_known for result in results].index(True)
    # From then on it is kept.
    assert {result.distortion for result in results[first:]} == {results[first].distortion}


def test_keyframes_that_came_before_the_map_are_given_their_place_later(tracked: list[Tracked]) -> None:
    revised = [result for result in tracked if result.revised]
    assert revised
    assert revised[0].number == 0
    pose = revised[0].pose
    np.testing.assert_allclose([pose.x, pose.y, pose.yaw, pose.height], [0.0, 0.0, 0.0, 1.0], atol=1e-9)
    assert all(result.placement is not None for result in revised)


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_WINDOW", 10)
    tracker = _tracker(DISTORTION)
    for frame in _features(_drive(40, overlap=0.6, path="line")):
        tracker.add(frame, Camera(SIZE))
    assert len(tracker._keyframes) == 10
    first = tracker._keyframes[0].number
    assert first >= 25
    assert tracker._window_links
    assert all(link.image1 >= first for link in tracker._window_links)


def test_a_camera_that_stands_still_makes_no_keyframes() -> None:
    frames, tracker = _features(_drive(12)), _tracker()
    for frame in frames:
        tracker.add(frame, Camera(SIZE))
    results = [tracker.add(frames[-1], Camera(SIZE)) for _ in range(5)]
    assert [len(result) for result in results] == [1] * 5
    assert not any(result[-1].keyframe for result in results)
    poses = [result[-1].pose for result in results]
    assert all(pose is not None and pose == poses[0] for pose in poses)


def test_a_frame_of_something_else_has_no_place_and_the_next_one_has() -> None:
    frames, tracker = _features(_drive(16)), _tracker()
    strangers = _features(_drive(16), world=7)
    for frame in frames[:14]:
        tracker.add(frame, Camera(SIZE))
    lost = tracker.add(strangers[3], Camera(SIZE))[-1]
    assert lost.placement is None
    assert lost.inliers == 0
    assert lost.map_number == 0
    assert tracker.add(frames[14], Camera(SIZE))[-1].placement is not None


def test_a_new_map_begins_where_the_track_is_lost_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MAX_LOST_FRAMES", 3)
    frames, tracker = _features(_drive(8)), _tracker()
    elsewhere = _features(_drive(11, path="line"), world=7)
    before = [tracker.add(frame, Camera(SIZE))[-1] for frame in frames]
    after = [tracker.add(frame, Camera(SIZE))[-1] for frame in elsewhere]
    assert {result.map_number for result in before} == {0}
    assert [result.placement for result in after[: module._MAX_LOST_FRAMES]] == [None] * module._MAX_LOST_FRAMES
    assert after[-1].map_number == 1
    assert after[-1].placement is not None


def test_frames_without_features_are_none_to_wait_for() -> None:
    tracker = _tracker()
    none = np.zeros(0)
    empty = Features(np.zeros((0, 2)), np.zeros((0, 32), np.float32), none, none, none, None, "made up", SIZE)
    frames = _features(_drive(14))
    for frame in [empty, empty, *frames]:
        result = tracker.add(frame, Camera(SIZE))[-1]
    assert result.map_number == 0
    assert result.placement is not None


@pytest.fixture(scope="module")
def video() -> tuple[Sequence, list[NDArray[np.uint8]]]:
    """Frames of a floor that follow one another closely."""
    drive = floor_drive("turn", 60, seed=4, size=SIZE, overlap=0.95)
    return drive, [drive.frame(index) for index in range(len(drive))]


@pytest.mark.parametrize("body", [False, True])
def test_between_keyframes_corners_are_followed(video: tuple[Sequence, list[NDArray[np.uint8]]], body: bool) -> None:
    drive, images = video
    if body:  # of the robot, which stays where it is in the image and has corners of its own
        part = np.kron(np.random.default_rng(1).integers(0, 255, (5, 32, 3)), np.ones((10, 10, 1))).astype(np.uint8)
        images = [np.concatenate([image[:190], part]) for image in images]
    asked: list[int] = []
    tracker, results = _tracker(DISTORTION), []
    for index, image in enumerate(images):

        def features(index: int = index, image: NDArray[np.uint8] = image) -> Features:
            asked.append(index)
            return detect(image, FeatureOptions(max_features=600), mask=MASK if body else None)

        results += tracker.add(features, Camera(SIZE), prepare(View(image), None))
    last = {result.number: result for result in results if not result.revised}
    keyframes = [number for number, result in last.items() if result.keyframe]
    assert set(keyframes) <= set(asked)
    assert len(asked) < len(keyframes) + 5 < 35
    placed = [result for result in results if result.placement is not None]
    assert {result.number for result in placed} >= set(range(keyframes[4], len(images)))
    error = compare_trajectories(_path(placed), true_path(drive))
    assert error.drift < 0.002
    assert error.rotation < math.radians(0.1)


def test_a_cut_is_no_motion(video: tuple[Sequence, list[NDArray[np.uint8]]]) -> None:
    _, images = video
    flow = CornerFlow()
    flow.begin(prepare(View(images[0]), None))
    found = flow.follow(prepare(View(np.ascontiguousarray(images[40][::-1])), None))
    if found is not None:
        _, inliers = fitted_affine(*found, 1.5)
        assert inliers.mean() < 0.5
    flow.begin(prepare(View(np.full((*SIZE[::-1], 3), 128, dtype=np.uint8)), None))
    assert flow.follow(prepare(View(images[0]), None)) is None
