"""What is seen on terminals: bars, the last line, help in groups, and encodings that know no λ."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rdstitch_cli.parameter_types import UserPath
from rdstitch_cli.terminal import Reporter, spell_out

from rdstitch.io import read_image
from tests.cli.running import CACHED, Run
from tests.sampled import sampled

_RUN = "from rdstitch_cli.main import main; main()"


def _process(*arguments: str | Path, **environment: str) -> "subprocess.CompletedProcess[bytes]":
    locale = ("LC_", "LANG", "PYTHONUTF8")
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(locale)}
    return subprocess.run(
        [sys.executable, "-c", _RUN, *arguments], capture_output=True, check=False, env={**inherited, **environment}
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


def test_nothing_is_said_when_quiet_or_nothing_was_made(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    assert rdstitch("pano", *frames, "-o", tmp_path / "pano.png", "-q", *CACHED).made == ""
    assert rdstitch("pano", *frames, "-o", tmp_path / "dry.png", "--dry-run", *CACHED).made == ""


def test_the_bar_is_gone_before_lambda(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with Reporter(0) as reporter:
        reporter("compositing", 95, 100)
        assert "compositing" in capfd.readouterr().err
        reporter.finish()
        left = capfd.readouterr().err
        assert left.rstrip(" ").endswith("\r")  # wiped out


def test_preview_is_small_and_leaves_what_is_given(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    rdstitch("pano", *frames, "-o", tmp_path / "small.png", "--preview", "--max-size", "200", "-j", "1")
    assert 190 <= max(read_image(tmp_path / "small.png").pixels.shape[:2]) <= 200


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
    assert UserPath().convert("~no-such-user/x", None, None) == Path("~no-such-user/x")
