"""Runs that end in the middle: nothing is left behind or half-written, and the next run goes on from the cache."""

import json
import os
import random
import signal
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from rdstitch_cli.main import run

from rdstitch.io import read_image
from rdstitch.synthetic import ground
from tests.cli.running import FAST, Outcome, finished, start, state_of
from tests.sampled import sampled

_IMAGES = 64  # enough for worker processes


@pytest.fixture
def strip(tmp_path: Path) -> Path:
    folder = tmp_path / "strip"
    folder.mkdir()
    width, height, step = 200, 150, 60
    whole = ground((width + step * _IMAGES, height + 40), 5, 1).region(0, 0, width + step * _IMAGES, height + 40)
    for index in range(_IMAGES):
        part = whole[10 + 5 * (index % 5) :, step * index :][:height, :width]
        cv2.imwrite(str(folder / f"{index:02d}.png"), np.rint(part * 255.0).astype(np.uint8))
    return folder


def _children(process: int) -> list[int]:
    """Processes that any thread of a process has started."""
    threads = Path(f"/proc/{process}/task").iterdir()
    return [int(child) for thread in threads for child in (thread / "children").read_text().split()]


@pytest.mark.skipif(not Path(f"/proc/self/task/{os.getpid()}/children").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("continued", sampled([False, True]))
def test_an_interrupted_run_ends_its_workers_and_can_be_continued(strip: Path, tmp_path: Path, continued: bool) -> None:
    options = ("-j", "2", "--max-features", "200", "-v", "--cache", tmp_path / "cache")
    arguments = ("calibrate", strip, "-o", tmp_path / "camera.json", *options)
    process = start(*arguments)
    while not process.stderr.readline().startswith(b"rdstitch: comparing"):
        assert process.poll() is None
    workers = _children(process.pid)
    assert len(workers) == 2
    process.send_signal(signal.SIGINT)
    done = finished(process)
    assert done.status == 130
    assert done.line.endswith("interrupted; the same command goes on from the cache")
    assert not any(Path(f"/proc/{worker}").exists() for worker in workers)
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache" / "features").rglob("*") if path.is_file()}
    assert len(kept) == _IMAGES
    if continued:
        assert finished(start(*arguments)).status == 0
        assert {path: path.stat().st_mtime_ns for path in kept} == kept


def test_debug_shows_where(capsys: pytest.CaptureFixture[str], place: Path) -> None:
    status = run(["--debug", "pano", str(place / "a.png"), str(place / "missing.png"), "-o", str(place / "out.png")])
    assert status == 3
    assert "Traceback" in capsys.readouterr().err


def test_nobody_reads_the_output(place: Path) -> None:
    process = start("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *FAST)
    process.stdout.close()
    said = process.stderr.read()
    process.stderr.close()
    assert process.wait() == 141
    assert Outcome.of(0, "", said.decode()).err == ""
    assert (place / "out.png").exists()


@pytest.mark.parametrize("signal_number", sampled([signal.SIGTERM, signal.SIGINT]))
def test_termination_leaves_nothing_behind(place: Path, signal_number: int) -> None:
    before = state_of(place)
    process = start("pano", place / "a.png", place / "b.png", "-o", place / "out.png", "-v", *FAST)
    assert process.stderr.readline().startswith(b"rdstitch: detecting")
    process.send_signal(signal_number)
    done = finished(process)
    assert done.status == 128 + signal_number
    assert done.line.endswith("interrupted")
    assert state_of(place) == before


@pytest.mark.parametrize("attempt", sampled(range(int(os.environ.get("RDSTITCH_KILLS", "4")))))
def test_killed_at_any_moment(place: Path, attempt: int) -> None:
    command = ("pano", place / "a.png", place / "b.png", "-o", place / "out.png", "--overwrite", *FAST)
    assert finished(start(*command, "--max-size", "100")).status == 0
    old = (place / "out.png").read_bytes()
    process = start(*command, "-v")
    assert process.stderr.readline()
    time.sleep(random.Random(attempt).uniform(0.0, 1.5))
    process.kill()
    finished(process)
    if (place / "out.png").read_bytes() != old:
        assert read_image(place / "out.png").pixels.size > 0
    assert json.loads((place / "out.png.json").read_text(encoding="utf-8"))["verdict"]["ok"]
    # What a killed run leaves is hidden, and no input of the next one.
    done = finished(start("mosaic", place, "-o", place / "out.png", "--overwrite", *FAST))
    assert (done.status, done.err) == (0, "")
    assert read_image(place / "out.png").pixels.size > 0
