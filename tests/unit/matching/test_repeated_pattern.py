"""What misleads matching: rough ground, one that stays with the camera, repeated patterns, the same pixels twice."""

import tracemalloc
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import rdstitch
from examples.worlds.correspondences import stored
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.features import Correspondences, FeatureOptions, Features, detect, match
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.copies import copies_of, near_copies_of, without_copies
from rdstitch.matching.feature_store import FeatureStore, StoredMatches
from rdstitch.matching.pair_estimator import FeatureMatching, PairEstimator
from rdstitch.matching.repeated_pattern import _MIN_REPETITION, match_pattern, match_repeated_patterns, repetition
from rdstitch.matching.rough_ground import over_rough_ground
from rdstitch.matching.static_background import has_static_background, is_static_pair, moving_features, show_motion
from rdstitch.matching.two_view import PairRegistration
from rdstitch.robust import EstimationOptions
from rdstitch.synthetic import ImageTexture, Photometry, RenderedSequence, grid_poses, ground, sequence_over

CAMERA = Camera((640, 480), -0.2)
POINTS = np.random.default_rng(0).uniform((5.0, 5.0), (634.0, 474.0), (300, 2))
RIGHT = np.arange(300) < 240  # the others are matched with anything
PLANE = POINTS[:, 0] < 250.0


def _pair(parallax: FloatArray, plane: BoolArray = PLANE) -> PairRegistration:
    """A pair whose plane has no motion, of which ``plane`` are inliers."""
    points2 = POINTS + np.column_stack([parallax, np.zeros(300)])
    points2[~RIGHT] = np.random.default_rng(1).uniform((0.0, 0.0), (639.0, 479.0), (60, 2))
    relation = RadialHomography(np.eye(3), CAMERA, CAMERA, plane & RIGHT, distortion_std=0.01)
    relation = replace(relation, model="rigid", rms=0.7, parameters=("distortion",), covariance=np.eye(1))
    return PairRegistration(0, 1, stored(POINTS, points2), relation)


def test_the_other_flank_of_a_valley_belongs_to_the_ground() -> None:
    pair = _pair(np.maximum(POINTS[:, 0] - 250.0, 0.0) * 0.08)
    failed = replace(pair, image2=2, relation=RadialHomography.failed("little in common", CAMERA, CAMERA, 300))
    rough, same = over_rough_ground([pair, failed], 3.0)
    assert same is failed
    relation = rough.relation
    assert (relation.model, relation.motion, relation.parameters, relation.covariance.size) == (
        "homography",
        None,
        (),
        0,
    )
    assert relation.inliers[RIGHT].mean() > 0.98
    assert relation.inliers[~RIGHT].mean() < 0.1
    matched = rough.correspondences
    errors = np.linalg.norm(relation.transfer(matched.points1) - matched.points2, axis=1)[RIGHT]
    assert relation.rms == pytest.approx(np.sqrt(np.mean(errors[relation.inliers[RIGHT]] ** 2)), rel=0.05)
    assert np.sqrt(np.mean(errors**2)) < 8.0  # 31 pixels at the far side, by the plane of the near one
    assert (relation.distortion, relation.distortion_std) == (-0.2, 0.01)
    (again,) = over_rough_ground([rough], 3.0)
    assert again is rough


@pytest.mark.parametrize("step", [0.0, 25.0])
def test_flat_ground_and_what_moves_on_it_stay_as_they_are(step: float) -> None:
    """A vehicle over half of what both show ends with a step."""
    pair = _pair(np.where(PLANE, 0.0, step), PLANE if step else RIGHT)
    (found,) = over_rough_ground([pair], 3.0)
    assert found is pair


THRESHOLD = 3.0
LENS = Camera((640, 480))


def _still(moved: FloatArray, image1: int = 0, image2: int = 1) -> PairRegistration:
    """A registered pair whose matches all agree, each moved to the right by so many pixels."""
    count = len(moved)
    points = np.random.default_rng(0).uniform((0.0, 0.0), (600.0, 479.0), (count, 2))
    indices = np.stack([np.arange(count), np.arange(count)[::-1]], axis=1)
    matched = Correspondences(indices, points, points + np.stack([moved, np.zeros(count)], axis=1), np.ones(count))
    relation = RadialHomography(np.eye(3), LENS, LENS, np.ones(count, np.bool_))
    return PairRegistration(image1, image2, StoredMatches.of(matched), relation)


def _numbered(points: FloatArray, lens: Camera = LENS) -> Features:
    """Features that all look alike, and whose scales are their numbers."""
    one, numbers = np.ones(len(points)), np.arange(float(len(points)))
    descriptors = np.zeros((len(points), 8), np.float32)
    return Features(points, descriptors, numbers, one, one, None, "made up", lens.image_size)


def _failed(image1: int, image2: int) -> PairRegistration:
    pair = _still(np.zeros(10), image1, image2)
    return PairRegistration(image1, image2, pair.matches, RadialHomography.failed("no", LENS, LENS, 10))


@pytest.mark.parametrize(("moved", "static"), [(0.0, True), (0.9, True), (1.1, False), (2.0, False), (40.0, False)])
def test_a_pair_is_static_where_most_inliers_move_less_than_a_third_of_it(moved: float, static: bool) -> None:
    assert is_static_pair(_still(np.full(40, moved)), THRESHOLD) is static
    # Most decide, not the mean and not all.
    assert is_static_pair(_still(np.append(np.full(31, moved), np.full(9, 90.0))), THRESHOLD) is static


def test_only_inliers_decide_and_no_failed_pair_is_static() -> None:
    pair = _still(np.append(np.full(10, 20.0), np.zeros(30)))
    pair.relation.inliers[10:] = False
    assert not is_static_pair(pair, THRESHOLD)
    assert not is_static_pair(_failed(0, 1), THRESHOLD)


def test_what_moves_by_less_than_the_threshold_is_taken_out_of_static_pairs_only() -> None:
    count = 40
    features = [_numbered(np.zeros((count, 2)))] * 3
    # Of the static pair, ten matches move by more than the threshold.
    moved = np.append(np.zeros(28), [2.9, 2.9, *[3.1] * 5, *[50.0] * 5])
    pairs = [_still(moved), _still(np.full(count, 30.0), 1, 2), _failed(0, 2)]
    left = [found.scale.tolist() for found in moving_features(FeatureStore.of(features), pairs, THRESHOLD)]
    assert left == [list(range(30, 40)), list(range(10)), list(range(40))]


def test_most_pairs_are_static_by_their_majority() -> None:
    rest, move = _still(np.zeros(40)), _still(np.full(40, 30.0))
    assert has_static_background([rest, rest, move], THRESHOLD)
    assert not has_static_background([rest, move], THRESHOLD)
    assert not has_static_background([rest, move, _failed(0, 1)], THRESHOLD)


@pytest.mark.parametrize(
    ("links", "count", "shown"),
    [
        ([(0, 1), (1, 2)], 3, True),
        ([(0, 1)], 2, False),  # two images may do so by chance
        ([(0, 1), (1, 2)], 6, True),
        ([(0, 1), (1, 2)], 7, False),  # less than half
        ([(0, 1), (2, 3), (4, 5)], 6, False),  # not connected
    ],
)
def test_motion_is_shown_by_a_connected_good_part(links: list[tuple[int, int]], count: int, shown: bool) -> None:
    pairs = [_still(np.full(40, 30.0), *link) for link in links]
    pairs += [_still(np.zeros(40), 0, other) for other in range(1, count)]
    assert show_motion(pairs, count, THRESHOLD) is shown


def _with_overlay(static: int, image1: int = 0, image2: int = 1, *, seed: int = 0) -> PairRegistration:
    """A pair that moves by 30 pixels, with so many static outliers at the same places of every such pair."""
    pair = _still(np.append(np.full(40, 30.0), np.full(static, 0.2)), image1, image2)
    pair.relation.inliers[40:] = False
    pair.correspondences.points1[:40] += np.random.default_rng(seed).uniform(0.0, 100.0, (40, 2))
    return pair


def test_static_matches_besides_motion_are_a_background_where_several_pairs_have_them() -> None:
    move = _still(np.full(40, 30.0))
    assert has_static_background([_with_overlay(8), _with_overlay(8), move], THRESHOLD)
    assert not has_static_background([_with_overlay(7), _with_overlay(7), move], THRESHOLD)
    assert not has_static_background([_with_overlay(8), move, move], THRESHOLD)
    assert not has_static_background([_with_overlay(8), _with_overlay(8), *[move] * 9], THRESHOLD)


def test_of_a_pair_that_moves_only_static_outliers_are_taken_out() -> None:
    features = [_numbered(np.zeros((48, 2)))] * 2
    first, second = moving_features(FeatureStore.of(features), [_with_overlay(8)], THRESHOLD)
    assert first.scale.tolist() == list(range(40))
    assert second.scale.tolist() == list(range(8, 48))


@pytest.mark.parametrize(("pairs", "left"), [(3, 40), (2, 48)])
def test_a_place_is_static_from_three_static_matches_on(pairs: int, left: int) -> None:
    """Of an image of which no pair was estimated."""
    seen = [_with_overlay(8, 0, 1 + k, seed=k) for k in range(pairs)]
    points = seen[0].correspondences.points1.copy()
    points[40:] += (0.6, 0.7)  # nearer than a static match moves
    features = [_numbered(points)] * 6
    assert len(moving_features(FeatureStore.of(features), seen, THRESHOLD)[5]) == left


def test_a_place_is_static_in_images_of_the_same_size_only() -> None:
    small = [_still(np.zeros(40), *images) for images in ((0, 1), (1, 2), (0, 2))]
    large, seen = Camera((4000, 3000)), _still(np.full(40, 30.0), 3, 4)
    pairs = [*small, replace(seen, relation=replace(seen.relation, camera=large, camera2=large))]
    features = [_numbered(seen.correspondences.points1, lens) for lens in (LENS, LENS, LENS, large, large)]
    assert [len(left) for left in moving_features(FeatureStore.of(features), pairs, THRESHOLD)] == [0, 0, 0, 40, 40]


def test_pairs_of_a_board_are_matched_where_others_are(board: RenderedSequence) -> None:
    said, tasks = list[str](), list[object]()

    class Counting(ThreadPoolExecutor):
        def submit(self, run: Callable[..., object], /, *arguments: object, **named: object) -> Future[object]:  # type: ignore[override]
            tasks.append(run)
            return super().submit(run, *arguments, **named)

    features = FeatureStore.of([_features(board, k) for k in range(3)])
    with Counting(1) as executor:
        cameras, options = [_LENS.with_guessed_focal()] * 3, EstimationOptions()
        matching = FeatureMatching(match)
        estimator = PairEstimator(features, cameras, matching, options, lambda stage, *_: said.append(stage), executor)
        failed = [replace(_failed(i, j)) for i, j in ((0, 1), (1, 2))]
        found = match_repeated_patterns(estimator, failed)
    assert all(pair.relation for pair in found)
    assert said[:2] == ["matching a repeated pattern"] * 2
    assert len(tasks) > 2


_SIDE = 40
_LENS = Camera((400, 300), distortion=-0.25, focal=380.0)
_OPTIONS = FeatureOptions(max_features=800)


@pytest.fixture(scope="module")
def board() -> RenderedSequence:
    """Images of a chessboard with some dirt on it, from above and aslant."""
    squares = np.kron(np.indices((20, 44)).sum(axis=0) % 2, np.ones((_SIDE, _SIDE)))
    rng = np.random.default_rng(0)
    dirt = np.asarray(cv2.GaussianBlur(rng.normal(0.0, 1.0, squares.shape), (0, 0), 3.0))  # type: ignore[call-overload]
    pixels = np.clip(60 + 130 * squares + 60 * dirt, 0, 255).astype(np.uint8)
    poses = grid_poses(_LENS, 4, 1, overlap=0.6, yaw=0.2, shift=0.05, seed=3).shaken(seed=4, tilt=0.12)
    return sequence_over(ImageTexture(pixels), _LENS, poses)


def _features(sequence: RenderedSequence, index: int) -> Features:
    return detect(sequence.frame(index), _OPTIONS)


def test_boards_repeat_themselves_and_ground_does_not(board: RenderedSequence) -> None:
    plain = sequence_over(partial(ground, seed=3), _LENS, board.poses)
    assert repetition(_features(board, 0)) > 2 * _MIN_REPETITION
    assert repetition(_features(plain, 0)) < _MIN_REPETITION / 2


def test_matches_are_right_or_off_by_whole_squares(board: RenderedSequence) -> None:
    first, second = _features(board, 0), _features(board, 1)
    found = match_pattern(first, second)
    assert len(found) > 100
    moved = board.to_plane(1, found.points2) - board.to_plane(0, found.points1)
    period = 2 * _SIDE  # of black and white squares
    whole = np.rint(np.median(moved, axis=0) / _SIDE) * _SIDE
    assert np.rint(whole.sum()) % period == 0
    assert np.mean(np.linalg.norm(moved - whole, axis=1) < 5.0) > 0.8
    assert len(np.unique(found.indices[:, 0])) == len(np.unique(found.indices[:, 1])) == len(found)


def test_other_ground_has_no_such_matches(board: RenderedSequence) -> None:
    plain = sequence_over(partial(ground, seed=3), _LENS, board.poses)
    assert len(match_pattern(_features(board, 0), _features(plain, 0))) < 30
    assert len(match_pattern(detect(board.frame(0), FeatureOptions("orb")), _features(board, 1))) == 0


def test_matching_many_keypoints_takes_memory_for_some_of_them_at_a_time(board: RenderedSequence) -> None:
    few = _features(board, 0)
    many = few.take(np.resize(np.arange(len(few)), 3000))
    tracemalloc.start()
    match_pattern(many, many)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6  # 108 MB of distances and their order


@pytest.mark.slow
def test_calibrate_matches_boards_so_and_mosaics_do_not(board: RenderedSequence) -> None:
    """A mosaic could be off by whole squares."""
    stages: dict[bool, set[str]] = {True: set(), False: set()}
    for lens_only, found in stages.items():
        options = rdstitch.StitchOptions(workers=1, features=_OPTIONS, dry_run=True, force=True)

        def progress(stage: str, done: int, total: int, found: set[str] = found) -> None:
            found.add(stage)

        if lens_only:
            registration = rdstitch.calibrate(board.frames(), options, progress=progress)
            assert registration.alignment.used.all()
            assert abs(registration.alignment.distortion + 0.25) < max(0.01, 3 * registration.alignment.distortion_std)
        else:
            rdstitch.mosaic(board.frames()[:3], None, options, progress=progress)
    assert "matching a repeated pattern" in stages[True] - stages[False]


OPTIONS = rdstitch.StitchOptions(workers=1, features=rdstitch.FeatureOptions(max_features=500))


def _seen_in_threes() -> list[NDArray[np.uint8]]:
    lens = Camera((320, 240), distortion=-0.15, focal=300.0)
    poses = grid_poses(lens, 3, 1, overlap=0.5, yaw=0.2, seed=3)
    return sequence_over(partial(ground, seed=3), lens, poses, photometry=Photometry(noise=0.01), seed=3).frames()


def _saved_again(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    noisy = frame.astype(int) + np.random.default_rng(0).integers(-1, 2, frame.shape)
    return np.clip(noisy, 0, 255).astype(frame.dtype)


@pytest.mark.parametrize("place", [0, 1, 3])
def test_a_copy_changes_nothing_and_lies_where_its_image_does(place: int) -> None:
    frames = _seen_in_threes()
    with_copy = [*frames]
    with_copy.insert(place, _saved_again(frames[1]))
    alone, found = (rdstitch.mosaic(images, None, OPTIONS).registration for images in (frames, with_copy))
    assert found.alignment.used.all()
    original = 2 if place <= 1 else 1
    np.testing.assert_array_equal(found.alignment.homographies[original], found.alignment.homographies[place])
    assert found.alignment.distortion_std == pytest.approx(alone.alignment.distortion_std, rel=0.1)
    assert abs(found.alignment.distortion - alone.alignment.distortion) < 0.3 * alone.alignment.distortion_std
    assert [message.code for message in found.alignment.messages].count("copies") == 1


def test_a_near_copy_changes_nothing_and_lies_where_it_was_taken() -> None:
    wide = _seen_in_threes()
    frames = [frame[:, :316] for frame in wide]
    images = [*frames, _saved_again(wide[1][:, 4:])]
    alone, found = (rdstitch.mosaic(some, None, OPTIONS).registration.alignment for some in (frames, images))
    assert (found.distortion, found.distortion_std) == (alone.distortion, alone.distortion_std)
    np.testing.assert_allclose(found.homographies[:3], alone.homographies, atol=1e-6)
    points = np.array([[40.0, 30.0], [160.0, 120.0], [280.0, 200.0]])
    # Its lens has the centre 4 pixels off the middle.
    np.testing.assert_allclose(found.transfer(1, 3, points), points - np.array([4.0, 0.0]), atol=0.6)


def _shifted(image1: int, image2: int, pixels: float) -> PairRegistration:
    homography = np.eye(3)
    homography[0, 2] = pixels / CAMERA.scale
    relation = RadialHomography(homography, CAMERA.with_coefficients(0.0), CAMERA, np.ones(300, dtype=np.bool_))
    return PairRegistration(image1, image2, stored(POINTS, POINTS + np.array([pixels, 0.0])), relation)


@pytest.mark.parametrize("neighbours", [1, 2, 3])
def test_copies_of_copies_are_copies_of_the_first_image(neighbours: int) -> None:
    pairs = [_shifted(i, i + k, 0.0) for i in range(10) for k in range(1, neighbours + 1) if i + k < 10]
    copies = copies_of(pairs)
    assert copies == dict.fromkeys(range(1, 10), 0)
    assert not without_copies(pairs, copies)


def test_what_moves_slowly_is_no_copy_of_where_it_was_long_ago() -> None:
    pairs = [_shifted(i, i + 1, 0.2) for i in range(10)]
    assert copies_of(pairs) == {1: 0, 2: 0, 4: 3, 5: 3, 7: 6, 8: 6, 10: 9}


def test_what_only_a_near_copy_reaches_is_no_less_joined() -> None:
    def shifted(image1: int, image2: int, pixels: float) -> PairRegistration:
        relation = RadialHomography(np.eye(3), CAMERA, CAMERA, np.ones(300, dtype=np.bool_))
        return PairRegistration(image1, image2, stored(POINTS, POINTS + np.array([pixels, 0.0])), relation)

    pairs = {(i, j): shifted(i, j, 3.0) for i, j in ((0, 1), (0, 2), (1, 2))}
    assert near_copies_of(pairs) == {1: 0, 2: 0}
    assert near_copies_of({**pairs, (1, 3): shifted(1, 3, 90.0)}) == {2: 0}
