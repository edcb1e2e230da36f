"""A board before the camera: no keypoint is distinctive, but the whole is."""

from functools import partial

import cv2
import numpy as np
import pytest

import rdstitch
from rdstitch.camera import Camera
from rdstitch.features import FeatureOptions, Features, detect
from rdstitch.matching.repeated_pattern import MIN_REPETITION, match_pattern, repetition
from rdstitch.synthetic import ImageTexture, Sequence, grid_poses, ground, sequence_over

_SIDE = 40
_LENS = Camera((400, 300), distortion=-0.25, focal=380.0)
_OPTIONS = FeatureOptions(max_features=800)


@pytest.fixture(scope="module")
def board() -> Sequence:
    """Images of a chessboard with some dirt on it, from above and aslant."""
    squares = np.kron(np.indices((20, 44)).sum(axis=0) % 2, np.ones((_SIDE, _SIDE)))
    rng = np.random.default_rng(0)
    dirt = np.asarray(cv2.GaussianBlur(rng.normal(0.0, 1.0, squares.shape), (0, 0), 3.0))  # type: ignore[call-overload]
    pixels = np.clip(60 + 130 * squares + 60 * dirt, 0, 255).astype(np.uint8)
    poses = grid_poses(_LENS, 4, 1, overlap=0.6, yaw=0.2, shift=0.05, seed=3).shaken(seed=4, tilt=0.12)
    return sequence_over(ImageTexture(pixels), _LENS, poses)


def _features(sequence: Sequence, index: int) -> Features:
    return detect(sequence.frame(index), _OPTIONS)


def test_boards_repeat_themselves_and_ground_does_not(board: Sequence) -> None:
    plain = sequence_over(partial(ground, seed=3), _LENS, board.poses)
    assert repetition(_features(board, 0)) > 2 * MIN_REPETITION
    assert repetition(_features(plain, 0)) < MIN_REPETITION / 2


def test_matches_are_right_or_off_by_whole_squares(board: Sequence) -> None:
    first, second = _features(board, 0), _features(board, 1)
    found = match_pattern(first, second)
    assert len(found) > 100
    moved = board.to_plane(1, found.points2) - board.to_plane(0, found.points1)
    period = 2 * _SIDE  # of black and white squares
    whole = np.rint(np.median(moved, axis=0) / _SIDE) * _SIDE
    assert np.rint(whole.sum()) % period == 0
    assert np.mean(np.linalg.norm(moved - whole, axis=1) < 5.0) > 0.8
    assert len(np.unique(found.indices[:, 0])) == len(np.unique(found.indices[:, 1])) == len(found)


def test_other_ground_has_no_such_matches(board: Sequence) -> None:
    plain = sequence_over(partial(ground, seed=3), _LENS, board.poses)
    assert len(match_pattern(_features(board, 0), _features(plain, 0))) < 30
    assert len(match_pattern(detect(board.frame(0), FeatureOptions("orb")), _features(board, 1))) == 0


@pytest.mark.slow
def test_calibrate_matches_boards_so_and_mosaics_do_not(board: Sequence) -> None:
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
