"""Ctrl-C with worker processes: everything ends at once, and the next run goes on from the cache."""

import os
import signal
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from rdstitch.synthetic import ground
from tests.cli.running import finished, start

_PICTURES = 64  # enough for worker processes


@pytest.fixture
def strip(tmp_path: Path) -> Path:
    """Parts of one picture."""
    folder = tmp_path / "strip"
    folder.mkdir()
    width, height, step = 200, 150, 60
    whole = ground((width + step * _PICTURES, height + 40), 5, 1).region(0, 0, width + step * _PICTURES, height + 40)
    for index in range(_PICTURES):
        part = whole[10 + 5 * (index % 5) :, step * index :][:height, :width]
        cv2.imwrite(str(folder / f"{index:02d}.png"), np.rint(part * 255.0).astype(np.uint8))
    return folder


def _children(process: int) -> list[int]:
    """Processes that any thread of a process has started."""
    threads = Path(f"/proc/{process}/task").iterdir()
    return [int(child) for thread in threads for child in (thread / "children").read_text().split()]


@pytest.mark.skipif(not Path(f"/proc/self/task/{os.getpid()}/children").exists(), reason="needs Linux's /proc")
def test_an_interrupted_run_ends_its_workers_and_can_be_continued(strip: Path, tmp_path: Path) -> None:
    options = ("-j", "2", "--max-features", "200", "-v", "--cache", tmp_path / "cache")
    arguments = ("calibrate", strip, "-o", tmp_path / "camera.json", *options)
    process = start(*arguments)
    assert process.stderr is not None
    while not process.stderr.readline().startswith(b"rdstitch: comparing"):
        assert process.poll() is None
    workers = _children(process.pid)
    assert len(workers) == 2
    begun = time.monotonic()
    process.send_signal(signal.SIGINT)
    done = finished(process)
    assert time.monotonic() - begun < 5.0
    assert done.status == 130
    assert done.line.endswith("interrupted")
    assert not any(Path(f"/proc/{worker}").exists() for worker in workers)
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache" / "features").rglob("*") if path.is_file()}
    assert len(kept) == _PICTURES
    assert finished(start(*arguments)).status == 0
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
