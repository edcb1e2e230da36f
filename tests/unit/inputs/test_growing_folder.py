"""When files that appear in a folder are read, by a clock of the test."""

import os
import time
from pathlib import Path

import pytest

from rdstitch.inputs import growing_folder
from rdstitch.inputs.growing_folder import GrowingFolder


class _Clock:
    """Time that passes while it is waited for."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def time(self) -> float:
        return time.time() + self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        assert self.now < 60.0


@pytest.mark.parametrize("ahead", [-3600.0, 0.0, 3600.0])
def test_a_damaged_file_is_reported_whatever_time_it_bears(
    ahead: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = _Clock()
    monkeypatch.setattr(growing_folder, "time", clock)
    file = tmp_path / "a.jpg"
    file.write_bytes(b"half an image")
    os.utime(file, 2 * (time.time() + ahead,))
    folder = GrowingFolder(tmp_path, idle=0.5)
    assert [folder.comes_again(frame) for frame in folder.frames()] == [True, False]
    assert clock.now < 5.0


def test_what_is_there_is_read_at_once_and_in_order_and_what_is_empty_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = _Clock()
    monkeypatch.setattr(growing_folder, "time", clock)
    for name in ("10.png", "9.png"):
        (tmp_path / name).write_bytes(b"an image")
    (tmp_path / "11.png").touch()
    assert [frame.path.name for frame in GrowingFolder(tmp_path, idle=0.0).frames()] == ["9.png", "10.png"]
    assert clock.now < 1.0
