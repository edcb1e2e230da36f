"""Where a run stands: the terminal, the folder's surroundings, and interruptions."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from rdstitch_cli.flags import FilePath
from rdstitch_cli.main import run
from rdstitch_cli.terminal import Reporter, spell_out

from rdstitch.io.read import read_image
from rdstitch.pipeline import recipes
from rdstitch.synthetic import ground
from tests.cli.running import CACHED, DISTORTION, FAST, Outcome, Run, finished, start, state_of
from tests.sampled import sampled

_PROGRAM = "from rdstitch_cli.main import main; main()"


def _process(*arguments: str | Path, **environment: str) -> "subprocess.CompletedProcess[bytes]":
    locale = ("LC_", "LANG", "PYTHONUTF8")
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(locale)}
    return subprocess.run(
        [sys.executable, "-c", _PROGRAM, *arguments], capture_output=True, check=False, env={**inherited, **environment}
    )


def test_the_last_line_says_what_was_made(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    done = rdstitch("pano", *frames, "-o", tmp_path / "pano.png", *CACHED)
    width, height = read_image(tmp_path / "pano.png").pixels.shape[1::-1]
    made = f"{tmp_path / 'pano.png'}: {width} x {height} pixels, 3 of 3 images, "
    assert done.made.startswith(made)
    assert re.fullmatch(r"λ = -0\.\d{4} ± 0\.\d{4}, \d+\.\d s", done.made[len(made) :])
    assert "pixels" not in done.out
    again = rdstitch("apply", tmp_path / "pano.png.json", "--images", frames[0].parent, "-o", tmp_path / "again.png")
    assert f"again.png: {width} x {height} pixels, 3 of 3 images," in again.made
    camera = rdstitch("calibrate", *frames, "-o", tmp_path / "camera.json", *CACHED)
    assert re.search(r"camera\.json: 3 of 3 images, λ = -0\.\d{4} ±", camera.made)
    path = rdstitch("trajectory", *frames, "-o", tmp_path / "path.csv", *CACHED)
    assert "path.csv: 3 of 3 images" in path.made
    straight = rdstitch("undistort", *frames, "-o", tmp_path / "straight", "--lambda", "-0.2")
    assert "straight: 3 images undistorted" in straight.made


def test_the_bar_is_gone_before_lambda(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with Reporter(0) as reporter:
        reporter("compositing", 95, 100)
        assert "compositing" in capfd.readouterr().err
        reporter.finish()
        left = capfd.readouterr().err
        assert left.rstrip(" ").endswith("\r")  # wiped out


def test_a_run_goes_on_where_nobody_reads_its_log(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", Mock(write=Mock(side_effect=BrokenPipeError)))
    Reporter(1).made("pano.jpg: 2 of 2 images")


def test_preview_is_small_and_leaves_what_is_given(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    rdstitch("pano", *frames, "-o", tmp_path / "small.png", "--preview", "--max-size", "200", "-j", "1")
    assert 190 <= max(read_image(tmp_path / "small.png").pixels.shape[:2]) <= 200


def test_a_preview_may_have_its_size_from_elsewhere(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    area = ("--extent", "0,0,100,100")
    # As without --preview: what is wrong is that these images have no place on the map.
    wanted = ("pano", *frames, "-o", tmp_path / "a.png", "--preview", *area, "-j", "1")
    rdstitch(*wanted, status=2, told="extent needs GPS positions")


def test_quality_makes_files_smaller(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    sizes = []
    for quality in ("95", "40"):
        file = tmp_path / f"q{quality}.jpg"
        rdstitch("pano", *frames, "-o", file, "--quality", quality, *CACHED)
        sizes.append(file.stat().st_size)
    assert sizes[1] < 0.5 * sizes[0]


def test_help_is_a_command_too(rdstitch: Run) -> None:
    assert rdstitch("help").out == rdstitch("--help").out
    assert rdstitch("help", "pano").out == rdstitch("pano", "--help").out
    rdstitch("help", "stitch", status=2)
    assert rdstitch("help", "no-overlap").out == rdstitch("help", "[no-overlap]").out
    assert "`rdstitch help left-out`" in rdstitch("help", "not-reliable").out
    assert rdstitch("-V").out == rdstitch("--version").out


@pytest.mark.parametrize(
    "environment", sampled([{"LANG": "C", "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}, {"PYTHONIOENCODING": "cp1252"}])
)
def test_output_without_greek_letters(environment: dict[str, str], frames: list[Path], tmp_path: Path) -> None:
    for name in ("pano", "calibrate", "trajectory"):
        shown = _process(name, "--help", **environment)
        assert (shown.returncode, shown.stderr) == (0, b"")
        assert b"lambda" in shown.stdout or "λ".encode() in shown.stdout
    done = _process("pano", *frames, "-o", tmp_path / "pano.png", *CACHED, **environment, PYTHONUTF8="0")
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 0
    last = done.stderr.splitlines()[-1]
    assert b"lambda = -0." in last
    assert last.endswith(b" s")


def test_characters_are_spelled_out_and_bytes_stay() -> None:
    def shown(text: str, encoding: str) -> bytes:
        import codecs

        codecs.register_error("rdstitch-test", spell_out)
        return text.encode(encoding, "rdstitch-test")

    assert shown("λ = -0.2 ± 0.1, ψ…", "ascii") == b"lambda = -0.2 +/- 0.1, psi..."
    assert shown("λ = -0.2 ± 0.1, ψ…", "cp1252") == b"lambda = -0.2 \xb1 0.1, psi\x85"
    assert shown("a\udcff\udcfeλ", "ascii") == b"a\xff\xfelambda"
    assert shown("日", "cp1252") == b"\\u65e5"


def test_tilde_is_the_home_folder_where_no_shell_saw_it(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    rdstitch("pano", *frames, "--output=~/pano.png", *CACHED)
    assert (tmp_path / "pano.png").exists()
    assert FilePath().convert("~no-such-user/x", None, None) == Path("~no-such-user/x")


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


def test_an_interrupt_says_that_there_is_a_cache(
    rdstitch: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "c.toml").write_text('[common]\ncache = "kept"\n', encoding="utf-8")
    monkeypatch.setattr(recipes, "calibrate", Mock(side_effect=KeyboardInterrupt))
    wanted = ("calibrate", tmp_path, "-o", tmp_path / "camera.json")
    rdstitch(*wanted, "--config", tmp_path / "c.toml", status=130, told="goes on from the cache")
    assert rdstitch(*wanted, "--", "--debug", status=130).line == "rdstitch: interrupted"


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


def test_what_nohup_ignores_stays_ignored() -> None:
    code = "import signal, sys; from rdstitch_cli import main; signal.signal(signal.SIGHUP, signal.SIG_IGN); "
    code += "main.run = lambda _: print(signal.getsignal(signal.SIGHUP) is signal.SIG_IGN) or 0; main.main()"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout == b"True\n"


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
