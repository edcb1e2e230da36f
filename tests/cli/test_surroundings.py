"""Surroundings that are not what programs expect: streams that are closed or full, and a folder that is gone."""

import sys
from pathlib import Path

import pytest

from tests.cli.running import CACHED, DISTORTION, finished, start

_PROGRAM = "from rdstitch_cli.main import main; main()"
_CLOSED = "import os, sys; [os.close(n) for n in {}]; os.execv({!r}, [{!r}, '-c', {!r}, *sys.argv[1:]])"


@pytest.mark.parametrize("closed", [(0, 1, 2), *(pytest.param((n,), marks=pytest.mark.slow) for n in range(3))])
def test_closed_streams(here: Path, closed: tuple[int, ...]) -> None:
    program = _CLOSED.format(closed, sys.executable, sys.executable, _PROGRAM)
    done = finished(start("pano", "a.png", "b.png", "-o", "out.png", *CACHED, program=program))
    assert (done.status, done.err) == (0, "")
    assert 1 in closed or abs(float(done.out) - DISTORTION) < 0.02
    # Nothing that is told goes into a file that has taken the place of a closed stream.
    assert (here / "out.png").read_bytes().startswith(b"\x89PNG")
    assert finished(start("mosaic", "-", "-o", "new.png", *CACHED, program=program)).status == 2
    assert finished(start("mosaic", "missing", "-o", "new.png", *CACHED, program=program)).status == 3


def test_full_streams(here: Path) -> None:
    full = "import os, sys; os.dup2(os.open('/dev/full', os.O_WRONLY), {}); " + _PROGRAM
    done = finished(start("pano", "a.png", "b.png", "-o", "out.png", *CACHED, program=full.format(1)))
    assert done.status == 6
    assert "standard output: cannot be written" in done.line
    assert finished(start("mosaic", "missing", "-o", "new.png", *CACHED, program=full.format(2))).status == 3


def test_a_current_folder_that_was_deleted(here: Path) -> None:
    gone = "import os; os.mkdir('gone'); os.chdir('gone'); os.rmdir('../gone'); " + _PROGRAM
    done = finished(start("mosaic", "more", "-o", "out.png", *CACHED, program=gone))
    assert done.status == 3
    assert "current folder" in done.line
    done = finished(start("mosaic", here / "more", "-o", here / "out.png", *CACHED, program=gone))
    assert (done.status, done.err) == (0, "")
