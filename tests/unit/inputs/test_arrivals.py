"""Frames as they arrive."""

import io
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.arrivals import Arrivals
from rdstitch.inputs.frame import Frame
from tests.videos import write_video


def _nowhere() -> Path:
    raise AssertionError("nothing needs to be written")


def _image(file: Path, level: int = 100) -> Path:
    assert cv2.imwrite(str(file), np.full((12, 16), level, np.uint8))
    return file


def _names(frames: Iterator[Frame]) -> list[str]:
    return [frame.path.name for frame in frames]


def test_what_is_in_a_folder_comes_in_natural_order_and_then_it_ends(tmp_path: Path) -> None:
    for name in ("f10.png", "f9.png", ".hidden.png", "notes.txt"):
        _image(tmp_path / name) if name.endswith("png") else (tmp_path / name).write_text("")
    arrivals = Arrivals(tmp_path, frames_folder=_nowhere, idle=0.01)
    assert _names(iter(arrivals)) == ["f9.png", "f10.png"]
    assert arrivals.inputs == [str(tmp_path)]


def test_a_file_that_rdstitch_wrote_is_none(tmp_path: Path) -> None:
    _image(tmp_path / "out.png")
    (tmp_path / "out.png.json").write_text('{"format": "rdstitch sidecar", "output": {"file": "out.png"}}')
    _image(tmp_path / "frame.png")
    assert _names(iter(Arrivals(tmp_path, frames_folder=_nowhere, idle=0.01))) == ["frame.png"]


def test_names_that_do_not_come_are_waited_for_no_longer_than_that() -> None:
    reading, writing = os.pipe()
    try:
        os.write(writing, b"one.png\n\n")
        stream = os.fdopen(reading, encoding="utf-8", closefd=False)
        assert _names(iter(Arrivals("-", frames_folder=_nowhere, names=stream, idle=0.1))) == ["one.png"]
    finally:
        os.close(writing)
    with pytest.raises(ArgumentError, match="no list"):
        Arrivals("-", frames_folder=_nowhere)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Six frames, ever lighter, at 5 frames a second."""
    return write_video(tmp_path / "drive.avi", (np.full((48, 64, 3), 40 * level, np.uint8) for level in range(6)))


def test_every_nth_frame_of_a_video_with_its_number_and_time(video: Path) -> None:
    arrivals = Arrivals(video, frames_folder=_nowhere, every=2)
    frames = list(arrivals)
    assert [frame.number for frame in frames] == [0, 2, 4]
    assert [frame.timestamp for frame in frames] == pytest.approx([0.0, 0.4, 0.8])
    assert [frame.path.name for frame in frames] == ["drive_000000.png", "drive_000002.png", "drive_000004.png"]
    images = [frame.image for frame in frames]
    assert [int(np.median(image.pixels)) for image in images if image] == pytest.approx([0, 80, 160], abs=3)
    assert arrivals.inputs == [str(video)]


def test_frames_of_a_stream_are_kept_since_they_come_only_once(video: Path, tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    folder.mkdir()
    arrivals = Arrivals(f"file://{video}", frames_folder=lambda: folder)
    frames = list(arrivals)
    if not frames:
        pytest.skip("this OpenCV opens no addresses")
    kept = [frame for frame in arrivals.inputs if isinstance(frame, Frame)]
    assert [frame.number for frame in kept] == [0, 1, 2, 3, 4, 5]
    assert all(frame.path.parent == folder and frame.path.exists() for frame in kept)
    assert [frame.timestamp for frame in kept] == [frame.timestamp for frame in frames]


def test_what_cannot_be_followed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be followed"):
        Arrivals(tmp_path / "nothing", frames_folder=_nowhere)
    with pytest.raises(InputError, match="cannot be followed"):
        Arrivals(_image(tmp_path / "image.png"), frames_folder=_nowhere)
    with pytest.raises(InputError, match="cannot open"):
        next(iter(Arrivals("tcp://127.0.0.1:9", frames_folder=_nowhere)))
    empty = io.StringIO("")
    assert list(Arrivals("-", frames_folder=_nowhere, names=empty)) == []
