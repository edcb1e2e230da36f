"""Outputs that cannot be written: one line that names the file, status 6, and what was there stays."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from rdstitch.io import read_image
from tests.cli.running import CACHED, FAST, Run, check_refused, finished, start, state_of
from tests.sampled import sampled


def _exists(place: Path) -> Path:
    (place / "out.png").write_bytes(b"mine")
    return place / "out.png"


def _sidecar_exists(place: Path) -> Path:
    (place / "out.png.json").write_bytes(b"mine")
    return place / "out.png"


def _is_input(place: Path) -> Path:
    return place / "a.png"


def _links_to_input(place: Path) -> Path:
    (place / "link.png").symlink_to("a.png")
    return place / "link.png"


def _is_folder(place: Path) -> Path:
    (place / "out.png").mkdir()
    return place / "out.png"


def _sidecar_is_folder(place: Path) -> Path:
    (place / "out.png.json").mkdir()
    return place / "out.png"


def _no_folder(place: Path) -> Path:
    return place / "missing" / "out.png"


def _under_a_file(place: Path) -> Path:
    return place / "a.png" / "out.png"


def _unknown_type(place: Path) -> Path:
    return place / "out.xyz"


def _no_type(place: Path) -> Path:
    return place / "out"


def _too_long(place: Path) -> Path:
    return place / ("x" * 300 + ".png")


@pytest.mark.parametrize(
    "make",
    [
        *(_exists, _sidecar_exists, _is_input, _links_to_input, _is_folder, _sidecar_is_folder, _no_folder),
        *(_under_a_file, _unknown_type, _no_type, _too_long),
    ],
)
@pytest.mark.parametrize("command", ["pano", "mosaic"])
def test_outputs_that_cannot_be(rdstitch: Run, place: Path, make: Callable[[Path], Path], command: str) -> None:
    output = make(place)
    before = state_of(place)
    done = rdstitch(command, place / "a.png", place / "b.png", "-o", output, *CACHED)
    check_refused(done, 6, output)
    assert state_of(place) == before
    if make in (_is_input, _links_to_input):
        done = rdstitch(command, place / "a.png", place / "b.png", "-o", output, "--overwrite", *CACHED)
        check_refused(done, 6, output)
        assert state_of(place) == before


def test_a_folder_that_may_not_be_written(rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Simulated: the superuser, under whom tests may run, may write everywhere.
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK and allowed(path, mode))
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *CACHED)
    check_refused(done, 6, place / "out.png")


@pytest.mark.parametrize("command", sampled(["pano", "calibrate", "trajectory", "undistort"]))
def test_a_full_disk(place: Path, command: str) -> None:
    output = place / {"pano": "out.png", "calibrate": "out.json", "trajectory": "out.csv", "undistort": "out"}[command]
    lens = ("--lambda", "-0.2") if command == "undistort" else FAST
    before = state_of(place)
    # No file may grow beyond this: the system refuses the write, as a full disk does.
    limited = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (20, 20)); "
        "from rdstitch_cli.main import run; sys.exit(run(sys.argv[1:]))"
    )
    arguments = (command, place / "a.png", place / "b.png", "-o", output, *lens)
    done = finished(start(*arguments, program=limited))
    check_refused(done, 6, output)
    assert {name: data for name, data in state_of(place).items() if name != "out"} == before
    assert finished(start(*arguments)).status == 0


def test_a_full_disk_keeps_the_old_image(rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (place / "out.png").write_bytes(b"old")
    before = state_of(place)

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    arguments = ("pano", place / "a.png", place / "b.png", "-o", place / "out.png", "--overwrite", *CACHED)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        check_refused(rdstitch(*arguments), 6, place / "out.png")
    assert state_of(place) == before
    assert rdstitch(*arguments).status == 0
    assert read_image(place / "out.png").pixels.size > 0
