"""Tracking: poses frame by frame, placement in the mosaic, and the preview."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from threading import Event

import numpy as np
import pytest
from numpy.typing import NDArray

from examples.judging.trajectories import compare_trajectories
from examples.worlds.floor_drives import floor_drive, true_path
from examples.worlds.paths import drive_poses
from rdstitch.alignment import AlignmentOptions
from rdstitch.features import FeatureOptions, Features, detect, match
from rdstitch.features.corner_flow import CornerFlow, corners_of, matched_corners
from rdstitch.features.prepared_image import PreparedImage, View, prepare
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.inputs.delays import DELAYS
from rdstitch.inputs.keyframes import fitted_affine
from rdstitch.inputs.odometry import BodyPose
from rdstitch.robust import EstimationOptions
from rdstitch.synthetic import RenderedSequence, blank, sequence_over
from rdstitch.tracking import (
    FrameTracker,
    Placement,
    PlaneSimilarity,
    Preview,
    TrackingResult,
)
from rdstitch.tracking.camera_check import check_given_camera, judge_camera
from rdstitch.tracking.camera_from_motion import CameraEstimate
from rdstitch.tracking.camera_knowledge import CameraKnowledge, FocalLength, FocalOrigin
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.map_refinement import MapRefinement
from rdstitch.tracking.metric_plane import MetricPlane
from rdstitch.tracking.odometry_prediction import OdometryPrediction
from rdstitch.tracking.tracked_frame import IncomingFrame, TrackedFrame
from rdstitch.trajectories.trajectory import Trajectory

SIZE = (320, 240)
DISTORTION = -0.25
MASK = np.arange(240)[:, None].repeat(320, axis=1) < 190


def _drive(count: int, overlap: float = 0.7, path: str = "turn") -> RenderedSequence:
    lens = Camera(SIZE, DISTORTION, focal=256.0)
    return sequence_over(blank, lens, drive_poses(lens, path, count, overlap=overlap, tilt=(0.05, -0.03)))


MADE_UP: dict[PreparedImage, Features] = {}


def _frames(sequence: RenderedSequence, world: int = 0) -> list[PreparedImage]:
    """Frames without corners, and in MADE_UP their features: points of the plane that are off by 0.2 pixels."""
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
        frames.append(_blank(Features(points, words[inside], ones, 0.0 * ones, ones, None, "made up", SIZE)))
    return frames


def _blank(features: Features) -> PreparedImage:
    image = prepare(View(np.zeros(SIZE[::-1], dtype=np.uint8)), None)
    MADE_UP[image] = features
    return image


def _tracker(
    distortion: float | None = None, detector: Callable[[PreparedImage], Features] = MADE_UP.__getitem__
) -> FrameTracker:
    options = EstimationOptions(distortion=distortion, select_below=50)
    return FrameTracker(options, AlignmentOptions(), detector, partial(match, ratio=0.8), ThreadPoolExecutor(1))


def _path(results: list[TrackingResult]) -> Trajectory:
    """The last pose given of each frame."""
    poses = {result.number: pose for result in results if (pose := result.pose) is not None}
    numbers = sorted(poses)
    places = np.array([(poses[k].x, poses[k].y) for k in numbers])
    yaw, height = (np.array([getattr(poses[k], name) for k in numbers]) for name in ("yaw", "height"))
    return Trajectory(np.array(numbers), places, yaw, height)


@pytest.fixture(scope="module")
def drive() -> RenderedSequence:
    return _drive(40)


@pytest.fixture(scope="module")
def tracked(drive: RenderedSequence) -> list[TrackingResult]:
    """What becomes of its frames where nothing is known."""
    tracker = _tracker()
    return [result for frame in _frames(drive) for result in tracker.add(frame, Camera(SIZE))]


def _check(results: list[TrackingResult], sequence: RenderedSequence) -> None:
    """Near the truth; every frame but those before the first alignment has a place when it comes."""
    error = compare_trajectories(_path(results), true_path(sequence))
    assert error.drift < 0.004
    assert error.rotation < math.radians(0.1)
    assert all(result.placement is not None for result in results if result.number >= 12)


def test_the_path_and_lambda_come_near_thetrue_path(tracked: list[TrackingResult], drive: RenderedSequence) -> None:
    _check(tracked, drive)
    assert abs(tracked[-1].distortion - DISTORTION) < 0.003


def test_a_frame_whose_place_is_not_finite_is_told_so(drive: RenderedSequence) -> None:
    known = EstimationOptions(distortion=DISTORTION), AlignmentOptions(tilt=(0.0, 0.0), lens_known=True)
    tracker = FrameTracker(*known, MADE_UP.__getitem__, partial(match, ratio=0.8), ThreadPoolExecutor(1))
    camera = Camera(SIZE, DISTORTION, focal=256.0, focal_source="option")
    attitudes = [np.full((len(DELAYS), 2), angle) for angle in (0.0, 0.0, np.nan)]
    *_, last = [tracker.add(f, camera, a)[-1] for f, a in zip(_frames(drive), attitudes, strict=False)]
    assert (last.pose, last.reason) == (None, "its place is not finite")


def test_a_lambda_that_is_given_is_kept(drive: RenderedSequence) -> None:
    tracker = _tracker(DISTORTION)
    results = [result for frame in _frames(drive)[:14] for result in tracker.add(frame, Camera(SIZE))]
    _check(results, drive)
    assert {(result.distortion, result.distortion_std) for result in results} == {(DISTORTION, 0.0)}
    assert all(result.distortion_known for result in results)


def test_lambda_becomes_surer_until_it_is_known(tracked: list[TrackingResult]) -> None:
    results = [result for result in tracked if not result.revised]
    stds = [result.distortion_std for result in results]
    assert stds[0] == math.inf
    assert 0.0 < stds[-1] < 0.5 * stds[3]
    first = [result.distortion_known for result in results].index(True)
    # From then on it is kept.
    assert {result.distortion for result in results[first:]} == {results[first].distortion}


def test_keyframes_that_came_before_the_map_are_given_their_place_later(tracked: list[TrackingResult]) -> None:
    revised = [result for result in tracked if result.revised]
    assert revised
    assert revised[0].number == 0
    pose = revised[0].pose
    np.testing.assert_allclose([pose.x, pose.y, pose.yaw, pose.height], [0.0, 0.0, 0.0, 1.0], atol=1e-9)
    assert all(result.placement is not None for result in revised)


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rdstitch.tracking.keyframe_map._WINDOW", 10)
    tracker = _tracker(DISTORTION)
    for frame in _frames(_drive(40, overlap=0.6, path="line")):
        tracker.add(frame, Camera(SIZE))
    assert len(tracker._map.keyframes) == 10
    first = tracker._map.keyframes[0].number
    assert first >= 25
    assert tracker._map.links
    assert all(link.image1 >= first for link in tracker._map.links)


def test_a_camera_that_stands_still_makes_no_keyframes() -> None:
    frames, tracker = _frames(_drive(12)), _tracker()
    for frame in frames:
        tracker.add(frame, Camera(SIZE))
    results = [tracker.add(frames[-1], Camera(SIZE)) for _ in range(5)]
    assert [len(result) for result in results] == [1] * 5
    assert not any(result[-1].keyframe for result in results)
    poses = [result[-1].pose for result in results]
    assert all(pose is not None and pose == poses[0] for pose in poses)


def test_a_frame_of_something_else_has_no_place_and_the_next_one_has() -> None:
    frames, tracker = _frames(_drive(16)), _tracker()
    strangers = _frames(_drive(16), world=7)
    for frame in frames[:14]:
        tracker.add(frame, Camera(SIZE))
    lost = tracker.add(strangers[3], Camera(SIZE))[-1]
    assert (lost.placement, lost.inliers, lost.map_number) == (None, 0, 0)
    assert lost.reason == "no keyframe shows what it shows"
    assert tracker.add(frames[14], Camera(SIZE))[-1].placement is not None


def test_a_new_map_begins_where_the_track_is_lost_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rdstitch.tracking.keyframe_map._MAX_LOST_FRAMES", 3)
    frames, tracker = _frames(_drive(8)), _tracker()
    elsewhere = _frames(_drive(13, path="line"), world=7)
    before = [tracker.add(frame, Camera(SIZE))[-1] for frame in frames]
    after = [tracker.add(frame, Camera(SIZE))[-1] for frame in elsewhere]
    assert {result.map_number for result in before} == {0}
    assert [result.placement for result in after[:3]] == [None] * 3
    assert after[-1].map_number == 1
    assert after[-1].placement is not None


def test_a_new_map_waits_until_all_keyframes_were_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rdstitch.tracking.keyframe_map._MAX_LOST_FRAMES", 2)
    one = KeyframeMap(_given_camera(), [_keyframe(0)], number=3)
    assert one.next_number == 3  # instead of a keyframe that no frame shows
    for lost_frames, searched, expected in ((1, 1, None), (2, 0, None), (2, 1, 4)):
        three = KeyframeMap(_given_camera(), [_keyframe(k) for k in range(3)], 3, lost_frames=lost_frames)
        three.searched = searched
        assert three.next_number == expected
    assert replace(one, has_plane=True, lost_frames=2).next_number == 4


def test_frames_without_features_are_none_to_wait_for() -> None:
    tracker = _tracker()
    none = np.zeros(0)
    empty = Features(np.zeros((0, 2)), np.zeros((0, 32), np.float32), none, none, none, None, "made up", SIZE)
    frames = _frames(_drive(14))
    for frame in [_blank(empty), _blank(empty), *frames]:
        result = tracker.add(frame, Camera(SIZE))[-1]
    assert result.map_number == 0
    assert result.placement is not None


@pytest.fixture(scope="module")
def video() -> tuple[RenderedSequence, list[NDArray[np.uint8]]]:
    """Frames of a floor that follow one another closely."""
    drive = floor_drive("turn", 60, seed=4, size=SIZE, overlap=0.95)
    return drive, [drive.frame(index) for index in range(len(drive))]


@pytest.mark.parametrize("body", [False, True])
def test_between_keyframes_corners_are_followed(
    video: tuple[RenderedSequence, list[NDArray[np.uint8]]], body: bool
) -> None:
    drive, images = video
    if body:  # of the robot, which stays where it is in the image and has corners of its own
        part = np.kron(np.random.default_rng(1).integers(0, 255, (5, 32, 3)), np.ones((10, 10, 1))).astype(np.uint8)
        images = [np.concatenate([image[:190], part]) for image in images]
    described: list[PreparedImage] = []

    def features(image: PreparedImage) -> Features:
        described.append(image)
        return detect(image.grey, FeatureOptions(max_features=600), mask=MASK if body else None)

    tracker, results = _tracker(DISTORTION, features), []
    for image in images:
        results += tracker.add(prepare(View(image), None), Camera(SIZE))
    keyframes = [result.number for result in results if result.keyframe and not result.revised]
    assert len(described) <= (len(keyframes) if body else 0)
    assert len(keyframes) < 30
    placed = [result for result in results if result.placement is not None]
    assert {result.number for result in placed} >= set(range(keyframes[5], len(images)))
    error = compare_trajectories(_path(placed), true_path(drive))
    assert error.drift < 0.001
    assert error.rotation < math.radians(0.03)


def test_a_frame_that_corners_place_is_not_lost_where_they_make_no_link(
    video: tuple[RenderedSequence, list[NDArray[np.uint8]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker = _tracker(DISTORTION, lambda image: detect(image.grey, FeatureOptions(max_features=600)))
    for image in video[1][:30]:
        tracker.add(prepare(View(image), None), Camera(SIZE))
    monkeypatch.setattr("rdstitch.tracking.keyframe_map.KeyframeMap.links_with", lambda *_: [])
    later = [tracker.add(prepare(View(image), None), Camera(SIZE))[-1] for image in video[1][30:36]]
    assert any(result.inliers for result in later)
    assert all(result.inliers > 0 for result in later if result.placement is not None)
    assert not tracker._map.lost_frames
    numbers = [frame.number for frame, *_ in tracker._map.between]
    assert len(set(numbers)) == len(numbers)


def test_where_no_homography_fits_frames_are_lost_and_keyframes_stay(
    drive: RenderedSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker, images = _tracker(), _frames(drive)
    for image in images[:12]:
        tracker.add(image, Camera(SIZE, focal=256.0))
    assert tracker._map.knowledge.plane is not None
    monkeypatch.setattr(
        "rdstitch.tracking.keyframe_map.fitted_homography",
        lambda *given: (None, np.zeros(len(given[2]), dtype=np.bool_)),
    )
    numbers = [keyframe.number for keyframe in tracker._map.keyframes]
    later = [tracker.add(image, Camera(SIZE, focal=256.0))[-1] for image in (*images[12:14], images[2])]
    assert [result.placement for result in later] == [None, None, None]
    assert [keyframe.number for keyframe in tracker._map.keyframes] == numbers
    # Keyframes by odometry have no links either: their lengths change all the same.
    before = [keyframe.pose for keyframe in tracker._map.keyframes[1:]]
    tracker._map.rescale(1.1)
    after = [keyframe.pose for keyframe in tracker._map.keyframes[1:]]
    tracker._map.links = []
    tracker._map.rescale(1.1)
    again = [keyframe.pose for keyframe in tracker._map.keyframes[1:]]
    for scale, poses in ((1.1, after), (1.21, again)):
        np.testing.assert_allclose([p.x for p in poses], [scale * p.x for p in before], rtol=1e-9)


def test_a_cut_is_no_motion(video: tuple[RenderedSequence, list[NDArray[np.uint8]]]) -> None:
    _, images = video
    flow, first = CornerFlow(), prepare(View(images[0]), None)
    flow.begin(first, corners_of(first))
    found = flow.follow(prepare(View(np.ascontiguousarray(images[40][::-1])), None))
    if found is not None:
        _, inliers = fitted_affine(*found, 1.5)
        assert inliers.mean() < 0.5
    grey = prepare(View(np.full((*SIZE[::-1], 3), 128, dtype=np.uint8)), None)
    flow.begin(grey, corners_of(grey))
    assert flow.follow(prepare(View(images[0]), None)) is None


def _placed(x: float, y: float, yaw: float, height: float, tilt: tuple[float, float] = (0.1, -0.2)) -> Placement:
    """``P = diag(f, f, 1) R Rz(φ) diag(1, 1, h) T(t)``, up to scale."""
    c, s, f = math.cos(yaw), math.sin(yaw), 1.3
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rows = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, height]])
    projection = np.diag([f, f, 1.0]) @ rotation_from_tilt(tilt) @ turn @ rows
    return Placement(Camera((640, 480), -0.2), 3.0 * np.linalg.inv(projection), f)


def _keyframe(number: int, placement: Placement | None = None) -> TrackedFrame:
    """Of a camera with a given focal length, on a body that moves ahead."""
    camera = Camera((640, 480), -0.2, focal=1.3 * 400.0, focal_source="option")
    image = prepare(View(np.zeros((480, 640), dtype=np.uint8)), None)
    static, body = CornerFlow().static_places, BodyPose(0.5 * number, 0.0, 0.0)
    frame = IncomingFrame(number, camera, image, MADE_UP.__getitem__, static, body=body)
    return TrackedFrame(frame, placement or _placed(number, 0.0, 0.0, 1.0), True, np.zeros((4, 4)), keyframe=True)


def _given_camera() -> CameraKnowledge:
    knowledge = CameraKnowledge.of(AlignmentOptions(lens_known=True), EstimationOptions(distortion=-0.2))
    focal = FocalLength(1.3, 0.01, FocalOrigin.GIVEN, 0.01)
    return replace(knowledge, focal=focal, plane=MetricPlane(1.3, (0.1, -0.2), True))


def test_keyframes_by_odometry_are_no_measurement_of_it() -> None:
    rng, odometry, keyframes, fits = np.random.default_rng(0), OdometryPrediction(), [], []
    for number in range(30):
        x, y = rng.normal((number, 0.0), 0.05)
        keyframes.append(_keyframe(number, _placed(x, y, 0.0, 1.0)))
        if number >= 8:
            keyframes[-1].move_to(odometry.place(keyframes[-1].frame, _given_camera()))
        odometry.latest = keyframes[-1]
        odometry.learn(keyframes)
        fits.append(odometry.mounted)
    assert fits[7].noise > 2.0
    assert {fit.scale for fit in fits[7:]} == {fits[7].scale}


def test_keyframes_without_links_show_nothing_of_the_camera() -> None:
    keyframe_map = KeyframeMap(_given_camera(), [_keyframe(23), _keyframe(24)], has_plane=True, added=24)
    assert check_given_camera(keyframe_map, keyframe_map.keyframes[-1].frame) is None


def test_a_given_camera_is_confirmed_or_replaced_or_gets_its_plane() -> None:
    knowledge, latest = _given_camera(), _keyframe(3).frame
    agreeing = CameraEstimate((0.1, -0.2), 0.001, 0.0, 0.0, 0.001, (0.12, -0.25), 0.0, 0.05)
    confirmed = judge_camera(knowledge, latest, agreeing, has_plane=True)
    assert (confirmed.surer, confirmed.length_factor, confirmed.messages) == (True, None, [])
    assert not judge_camera(confirmed.knowledge, latest, agreeing, has_plane=True).revises
    replaced = judge_camera(knowledge, latest, replace(agreeing, log_focal=0.2), has_plane=True)
    assert replaced.focal_replaced
    assert replaced.length_factor == pytest.approx(math.exp(-0.2))
    assert [message.code for message in replaced.messages] == ["focal-contradicted"]
    focal, plane = 1.3 * math.exp(0.2), agreeing.tilt_free_focal
    assert replaced.knowledge.focal == FocalLength(focal, 0.001, FocalOrigin.MOTION)
    assert replaced.knowledge.plane == MetricPlane(focal, plane, True, 0.001)
    for tilt_std, length_factor in ((0.1, None), (0.001, 1.0)):
        check = judge_camera(knowledge, latest, replace(agreeing, tilt_std=tilt_std), has_plane=False)
        assert (check.length_factor, check.revises) == (length_factor, length_factor is not None)


def test_an_alignment_that_is_dropped_keeps_no_worker_busy() -> None:
    with ThreadPoolExecutor(1) as executor:
        go_on, refinement = Event(), MapRefinement(executor, patient=True, report=print)
        executor.submit(go_on.wait)
        refinement.begin(KeyframeMap(_given_camera(), [_keyframe(0), _keyframe(1)], has_plane=True))
        future = refinement._window.future
        refinement.drop()
        go_on.set()
    assert future.cancelled()


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0, 1.0), (1.5, -2.0, 2.5, 0.8), (-3.0, 0.2, -3.0, 1.4)])
def test_the_pose_of_a_homography_is_the_one_it_was_made_of(pose: tuple[float, float, float, float]) -> None:
    placed = _placed(*pose)
    found = placed.pose
    np.testing.assert_allclose([found.x, found.y, found.yaw, found.height], pose, atol=1e-9)
    # Without focal length or homography there is none.
    assert Placement(placed.camera, placed.homography, None).pose is None
    assert Placement(placed.camera, np.full((3, 3), np.nan), 1.0).pose is None


def test_a_similarity_moves_a_placement_and_its_pose_alike() -> None:
    first, second = _placed(1.0, 2.0, 0.3, 0.9), _placed(2.0, 1.0, 1.1, 1.2)
    move = PlaneSimilarity.to_origin(first.pose)
    origin, other = move.applied(first).pose, move.applied(second).pose
    np.testing.assert_allclose([origin.x, origin.y, origin.yaw, origin.height], [0.0, 0.0, 0.0, 1.0], atol=1e-9)
    turned = np.array([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]]) @ [1.0, -1.0] / 0.9
    np.testing.assert_allclose([other.x, other.y, other.yaw, other.height], [*turned, 0.8, 1.2 / 0.9], atol=1e-9)


def test_planes_are_brought_together_by_the_images_that_both_have() -> None:
    placed = [_placed(0.0, 0.0, 0.2, 1.0), _placed(1.0, 0.5, -0.4, 1.1)]
    move = PlaneSimilarity(0.7 * complex(math.cos(1.0), math.sin(1.0)), 2.0 - 3.0j)
    found = PlaneSimilarity.between(placed, [move.applied(one) for one in placed])
    assert found.turn == pytest.approx(move.turn)
    assert found.shift == pytest.approx(move.shift)
    # A fit may keep the size.
    points = np.random.default_rng(0).normal(size=(20, 2))
    kept = PlaneSimilarity.fitted(points, 2.0 * points + 1.0, keep_size=True)
    assert abs(kept.turn) == pytest.approx(1.0)
    assert PlaneSimilarity.fitted(points, 2.0 * points + 1.0).turn == pytest.approx(2.0)


_CAMERA = Camera((160, 120))


def _at(x: float, y: float) -> Placement:
    """An image straight from above, one unit of the plane for half its diagonal."""
    return Placement(_CAMERA, np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]]), 1.0)


def _image(level: int) -> NDArray[np.uint8]:
    image = np.full((120, 160, 3), level, dtype=np.uint8)
    image[:60] //= 2  # darker above
    return image


def test_frames_lie_beside_one_another_the_right_way_up() -> None:
    preview = Preview()
    preview.paint(_image(200), _at(0.0, 0.0))
    preview.paint(_image(100), _at(1.6, 0.0))
    height, width = preview.pixels.shape[:2]
    assert width / height == pytest.approx(160 * 2 / 120, rel=0.02)
    assert preview.pixels.any(axis=2).mean() > 0.97
    above, below = preview.pixels[height // 4], preview.pixels[3 * height // 4]
    assert above[width // 4].tolist() == [100] * 3
    assert below[width // 4].tolist() == [200] * 3
    assert below[3 * width // 4].tolist() == [100] * 3


def test_it_grows_in_all_directions_and_stays_within_its_bound() -> None:
    preview = Preview(side=300)
    rng = np.random.default_rng(0)
    for place in rng.uniform(-6.0, 6.0, (40, 2)):
        preview.paint(_image(200), _at(*place))
    preview.paint(_image(240), _at(0.0, 0.0))
    assert max(preview.pixels.shape[:2]) <= 300
    assert max(preview.pixels.shape[:2]) > 150
    assert preview.pixels.any(axis=2).mean() > 0.3


@pytest.mark.parametrize(
    "homography",
    [
        [[1.0, 0.0, 1e5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],  # far off
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 1.0]],  # beyond the horizon
        [[100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 1.0]],  # far too large
    ],
)
def test_what_is_wrongly_placed_is_left_out_and_does_not_shrink_the_others(homography: list[list[float]]) -> None:
    preview = Preview()
    preview.paint(_image(200), _at(0.0, 0.0))
    before = preview.pixels.copy()
    preview.paint(_image(50), Placement(_CAMERA, np.array(homography), 1.0))
    assert np.array_equal(preview.pixels, before)
    preview.paint(_image(50), _at(1.6, 0.0))
    assert preview.pixels.any(axis=2).sum() > 1.9 * before.any(axis=2).sum()


@pytest.mark.parametrize(("dtype", "full"), [("uint8", 255), ("uint16", 65535), ("float32", 1.0)])
def test_grey_and_deep_frames_are_painted_in_eight_bits(dtype: str, full: float) -> None:
    preview = Preview()
    preview.paint(np.full((120, 160), full, dtype=dtype), _at(0.0, 0.0))
    assert preview.pixels[preview.pixels.any(axis=2)].min() == 255


def test_corners_are_matched_exactly_near_their_places(video: tuple[RenderedSequence, list[NDArray[np.uint8]]]) -> None:
    drive, images = video
    other, frame = (prepare(View(images[number]), None) for number in (2, 6))
    corners = corners_of(frame)

    def to_other(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(drive.to_image(2, drive.to_plane(6, points)) + np.array([0.7, -0.5]))

    before, now = matched_corners(other, frame, corners, to_other)
    assert len(before) > 100
    true = drive.to_image(6, drive.to_plane(2, before))
    assert np.median(np.linalg.norm(now - true, axis=1)) < 0.05
    nowhere = matched_corners(other, frame, corners, lambda points: np.full(points.shape, np.nan))
    assert [len(points) for points in nowhere] == [0, 0]
