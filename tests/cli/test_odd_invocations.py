"""Commands as people mistype them, and surroundings that are not what programs expect: one line, the right status."""

import shutil
import sys
from pathlib import Path

import pytest

from tests.cli.running import CACHED, DISTORTION, Run, finished, start

_PROGRAM = "from rdstitch_cli.main import main; main()"
_CLOSED = "import os, sys; [os.close(n) for n in {}]; os.execv({!r}, [{!r}, '-c', {!r}, *sys.argv[1:]])"


@pytest.fixture
def place(tmp_path: Path, frames: list[Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with two good images ``a.png`` and ``b.png`` and, in ``more``, two again."""
    (tmp_path / "more").mkdir()
    for name, frame in zip("ab", frames[:2], strict=True):
        shutil.copy(frame, tmp_path / f"{name}.png")
        shutil.copy(frame, tmp_path / "more")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("command", "status", "told"),
    [
        ("panos a.png b.png -o out.png", 2, "No such command 'panos'"),
        ("pano a.png b.png -o", 2, "requires an argument"),
        ("pano a.png b.png", 2, "'-o'"),
        ("pano a.png b.png -o out.png --blen none", 2, "--blend"),
        ("pano a.png b.png -o -", 6, "-: "),
        ("pano a.png nowhere://example.org/b.png -o out.png", 3, "nowhere:/example.org/b.png: "),
        ("mosaic @more -o out.png", 3, "more: "),
        ("mosaic a.png -o out.png", 2, "two different images"),
        ("pano a.png a.png -o out.png", 2, "a.png is named twice"),
        ("pano A.png b.png -o out.png", 3, "A.png: no such file; did you mean a.png?"),
        ("pano nofolder/a.png b.png -o out.png", 3, "there is no folder nofolder"),
        ("mosaic nofolder/ -o out.png", 3, "nofolder: no such folder"),
        ("mosaic . --exclude c -o out.png", 2, "they are called like a.png, and patterns like a* fit too"),
        ("a.png b.png -o out.png", 2, "'a.png' is not a command; name one first: rdstitch pano a.png b.png -o out.png"),
        ("-o out.png a.png b.png", 2, "-o belongs to a command: rdstitch pano -o out.png a.png b.png"),
        ("pano a.png b.png -o out.png --attitude a.csv", 3, "a.csv: is not a CSV file"),
        ("pano a.png b.png -o out.png --tilt 200,0", 2, "'--tilt'"),
        ("pano a.png b.png -o out.png --lambda 3", 2, "λ must lie between"),
        ("pano a.png b.png -o out.png --focal 1e300", 2, "has a focal length of 1e+300 pixels"),
        ("pano a.png b.png -o out.png --threshold nan", 2, "threshold"),
        ("pano a.png b.png -o out.png --scale 0", 2, "scale must lie between"),
        ("pano a.png b.png -o out.png --scale 1e300", 2, "scale must lie between"),
        ("pano a.png b.png -o out.png --threshold 1e308", 2, "threshold"),
        ("pano a.png b.png -o out.png --scale 1e-9", 2, "scale must lie between"),
        ("pano a.png b.png -o out.png --scale 100", 7, "--scale nearer to 1"),
        ("pano a.png b.png -o out.png --max-memory 1M", 7, "raise --max-memory"),
        ("pano a.png b.png -o out.png --camera a.png", 3, "a.png: "),
        ("pano a.png b.png -o out.png --report out.png", 6, "out.png: unknown file type"),
        ("pano a.png b.png -o out.png --save-camera more/../out.png.json", 6, "is the name of two outputs"),
        ("trajectory a.png b.png -o path --plot path", 6, "path: is the name of two outputs"),
        ("trajectory a.png b.png -o path --height nan", 2, "height must be positive"),
        ("apply a.png --images more -o out.png", 3, "a.png: "),
        ("apply more --images more -o out.png", 3, "more: "),
        ("undistort a.png -o . --lambda -0.2", 6, "a.png: is read as input"),
        ("undistort a.png -o straight", 2, "--camera FILE or --lambda L"),
    ],
)
def test_usage_errors_are_one_line(rdstitch: Run, place: Path, command: str, status: int, told: str) -> None:
    (place / "a.csv").write_bytes(b'name,psi,theta\n"a' + bytes(200_000))
    before = sorted(place.rglob("*"))
    done = rdstitch(*command.split(), *(CACHED if "out.png" in command and not command.startswith("apply") else ()))
    assert (done.status, done.out) == (status, ""), done.err
    assert told in done.line
    assert sorted(place.rglob("*")) == before


def test_images_that_nobody_here_can_read_are_named(
    rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("pillow_heif", "rawpy"):
        monkeypatch.setitem(sys.modules, package, None)
    for name in ("new.HEIC", "a.dng", "frame_0000.dng"):
        (place / "more" / name).write_bytes(b"raw")
    done = rdstitch("mosaic", "more", "-o", "out.png", *CACHED)
    assert done.status == 0
    # That of a raw file that has its JPEG beside it goes without saying.
    told = sorted(done.err.splitlines())
    assert [line.split(":")[2].strip() for line in told] == ["left out more/a.dng", "left out more/new.HEIC"]
    assert all("convert it to JPEG or TIFF" in line for line in told)
    assert rdstitch("pano", "a.png", "more/a.dng", "-o", "new.png", *CACHED).status == 3


@pytest.mark.parametrize("closed", [(0, 1, 2), *(pytest.param((n,), marks=pytest.mark.slow) for n in range(3))])
def test_closed_streams(place: Path, closed: tuple[int, ...]) -> None:
    program = _CLOSED.format(closed, sys.executable, sys.executable, _PROGRAM)
    done = finished(start("pano", "a.png", "b.png", "-o", "out.png", *CACHED, program=program))
    assert (done.status, done.err) == (0, "")
    assert 1 in closed or abs(float(done.out) - DISTORTION) < 0.02
    # Nothing that is told goes into a file that has taken the place of a closed stream.
    assert (place / "out.png").read_bytes().startswith(b"\x89PNG")
    assert finished(start("mosaic", "-", "-o", "new.png", *CACHED, program=program)).status == 2
    assert finished(start("mosaic", "missing", "-o", "new.png", *CACHED, program=program)).status == 3


def test_full_streams(place: Path) -> None:
    full = "import os, sys; os.dup2(os.open('/dev/full', os.O_WRONLY), {}); " + _PROGRAM
    done = finished(start("pano", "a.png", "b.png", "-o", "out.png", *CACHED, program=full.format(1)))
    assert done.status == 6
    assert "standard output: cannot be written" in done.line
    assert finished(start("mosaic", "missing", "-o", "new.png", *CACHED, program=full.format(2))).status == 3


def test_a_current_folder_that_was_deleted(place: Path) -> None:
    gone = "import os; os.mkdir('gone'); os.chdir('gone'); os.rmdir('../gone'); " + _PROGRAM
    done = finished(start("mosaic", "more", "-o", "out.png", *CACHED, program=gone))
    assert done.status == 3
    assert "current folder" in done.line
    done = finished(start("mosaic", place / "more", "-o", place / "out.png", *CACHED, program=gone))
    assert (done.status, done.err) == (0, "")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("@list.txt\n", "list.txt: the list of images names itself"),
        ("x" * 300, "File name too long"),
        ("a/" * 3000, "File name too long"),
        ("[ab].png\0missing\n.png", "missing .png: no such file"),
        ("\ufeffa.png\r\nmissing.png\r\n", "missing.png: no such file"),
    ],
)
def test_odd_lists(rdstitch: Run, place: Path, content: str, told: str) -> None:
    (place / "list.txt").write_text(content, encoding="utf-8", newline="")
    done = rdstitch("mosaic", "@list.txt", "-o", "out.png", "--strict", *CACHED)
    assert done.status in (3, 5), done.err
    assert told in done.line


def test_a_file_beside_an_image_that_is_no_sidecar(rdstitch: Run, place: Path) -> None:
    (place / "more" / "frame_0000.png.json").write_text("[" * 100_000, encoding="utf-8")
    assert rdstitch("mosaic", "more", "-o", "out.png", *CACHED).status == 0
