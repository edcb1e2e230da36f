"""Which frames of a video are taken."""

import itertools
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.inputs.find import find_images
from rdstitch.inputs.keyframes import FrameSelection, keyframes, select_keyframes, tracked, wanted_frames
from tests.videos import write_video

_WIDTH, _HEIGHT = 160, 120
_GROUND = np.asarray(
    cv2.resize(
        np.random.default_rng(0).integers(0, 255, (60, 240), dtype=np.uint8), (960, 240), interpolation=cv2.INTER_CUBIC
    ),
    dtype=np.uint8,
)


def _film(places: Iterable[float]) -> list[NDArray[np.uint8]]:
    """What a camera sees that looks at these places along the ground, pixels."""
    return [_GROUND[50 : 50 + _HEIGHT, int(x) : int(x) + _WIDTH].copy() for x in places]


def _share(frames: list[int], places: list[float]) -> list[float]:
    return [1.0 - abs(places[b] - places[a]) / _WIDTH for a, b in itertools.pairwise(frames)]


def test_frames_in_a_row_share_enough_and_no_more_are_taken_than_that_needs() -> None:
    places = [8.0 * k for k in range(90)]
    found = select_keyframes(tracked(_film(places)), 0.65)
    assert found[0] == 0
    assert 0.62 < min(_share(found, places)) <= max(_share(found, places)[:-1]) < 0.75
    assert places[-1] - places[found[-1]] <= 0.05 * _WIDTH
    large = [frame.repeat(4, axis=0).repeat(4, axis=1) for frame in _film(places[:30])]
    assert select_keyframes(tracked(large), 0.65)[:3] == pytest.approx(found[:3], abs=1)


def test_where_the_camera_turns_back_the_outermost_frame_is_taken() -> None:
    out = [4.0 * k for k in range(9)]
    places = [*out, *out[-2::-1], *(-x for x in out[1:])]
    found = select_keyframes(tracked(_film(x + 200.0 for x in places)), 0.65)
    assert max(places[k] for k in found) >= 32.0 - 0.03 * _WIDTH
    assert min(places[k] for k in found) <= -32.0 + 0.03 * _WIDTH


def test_of_a_camera_at_rest_two_frames_are_taken_few_share_more_and_all_that_cannot_be_followed_are_taken() -> None:
    assert keyframes(tracked(_film([100.0] * 30))) == [0, 29]
    assert len(keyframes(tracked(_film(8.0 * k for k in range(40))))) >= 12
    assert keyframes(tracked([np.zeros((_HEIGHT, _WIDTH), np.uint8)] * 6)) == list(range(6))


def test_what_stays_in_the_image_is_no_ground() -> None:
    frames = _film([4.0 * k for k in range(60)])
    body = np.asarray(np.random.default_rng(1).integers(0, 255, (70, _WIDTH)), dtype=np.uint8)
    body = np.asarray(cv2.GaussianBlur(body, (5, 5), 0), dtype=np.uint8)
    bare = select_keyframes(tracked(frames), 0.65)
    for frame in frames:
        frame[50:] = body
    assert len(bare) <= len(select_keyframes(tracked(frames), 0.65)) <= 1.5 * len(bare)


def test_after_a_cut_a_new_track_begins() -> None:
    frames = [*_film([0.0] * 5), *_film([700.0] * 5)]
    places = tracked(frames)
    assert places.track.tolist() == [0] * 5 + [1] * 5
    assert 5 in keyframes(places)


def test_every_nth_frame_is_taken_unseen_and_what_was_passed_over_is_said() -> None:
    wanted = wanted_frames(3, lambda: pytest.fail("nothing is to be decoded"))
    assert [k for k in range(8) if k in wanted] == [0, 3, 6]
    assert wanted.messages(Path("a.mp4")) == []
    (message,) = FrameSelection(chosen=frozenset((0, 2)), total=5).messages(Path("a.mp4"))
    assert "2 of 5 frames" in str(message)
    assert message.severity == "note"
    assert FrameSelection(chosen=frozenset((0, 1)), total=2).messages(Path("a.mp4")) == []


def test_a_frame_that_cannot_be_decoded_is_not_taken_and_changes_nothing_else() -> None:
    frames = _film(8.0 * k for k in range(60))
    whole = wanted_frames(None, lambda: frames[:-1])
    assert wanted_frames(None, lambda: [*frames[:-1], None]) == whole
    damaged = wanted_frames(None, lambda: [*frames[:20], None, *frames[20:]])
    assert damaged.chosen is not None
    assert 20 not in damaged.chosen
    assert len(damaged.chosen) <= len(whole.chosen or ()) + 2


def test_of_a_video_these_frames_are_written_unless_the_user_says_which(tmp_path: Path) -> None:
    file, folder = tmp_path / "drive.avi", tmp_path / "frames"
    folder.mkdir()
    write_video(file, _film([4.0 * k for k in range(60)] + [236.0] * 20), 25.0)
    found = find_images([file], frames_folder=lambda: folder)
    numbers = [frame.number for frame in found.frames]
    assert numbers[0] == 0
    assert 12 <= len(numbers) < 30
    assert sum(number is not None and number > 60 for number in numbers) <= 1
    assert f"{len(numbers)} of 80 frames" in str(found.messages[0])
    assert len(list(folder.rglob("*.png"))) == len(numbers)
    every = find_images([file], frames_folder=lambda: folder, every=20)
    assert [frame.number for frame in every.frames] == [0, 20, 40, 60]
    assert every.messages == []
