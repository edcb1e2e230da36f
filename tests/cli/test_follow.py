"""``--follow``: a line for each frame as it arrives, and in the end what a run over the whole folder gives."""

import json
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from rdstitch.io.read import read_image
from tests.cli.running import DISTORTION, FAST, Run, flight, start


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Nine pictures along a line."""
    return flight(5, 9, overlap=0.6).write(tmp_path_factory.mktemp("drive"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where the pictures arrive."""
    made = tmp_path / "incoming"
    made.mkdir()
    return made


def _line(process: "subprocess.Popen[bytes]") -> dict[str, Any]:
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, process.stderr.read().decode() if process.stderr else ""
    record: dict[str, Any] = json.loads(line)
    return record


def _rest(process: "subprocess.Popen[bytes]") -> list[dict[str, Any]]:
    output, _ = process.communicate(timeout=300)
    return [json.loads(line) for line in output.splitlines()]


def test_a_growing_folder_gives_poses_at_once_and_then_the_same_picture(
    rdstitch: Run, drive: list[Path], folder: Path, tmp_path: Path
) -> None:
    output, whole = tmp_path / "live.png", tmp_path / "whole.png"
    process = start("mosaic", folder, "-o", output, "--follow", "--idle", "4", "--refresh", "0.1", *FAST)
    lines = []
    arriving = drive[:6]
    for picture in arriving:
        shutil.copy(picture, folder)
        # Each line comes before the next picture does.
        while (line := _line(process))["revised"]:
            lines.append(line)
        assert line["name"] == picture.name
        lines.append(line)
    sketch = read_image(tmp_path / "live.preview.jpg")
    *_, last = _rest(process)
    assert process.returncode == 0
    assert last["used"] == last["frames"] == len(arriving)
    assert not (tmp_path / "live.preview.jpg").exists()
    assert sketch.pixels.max() > 0

    placed = {line["frame"]: line for line in lines if line["x"] is not None}
    assert sorted(placed) == list(range(len(arriving)))
    steps = [placed[k + 1]["x"] - placed[k]["x"] for k in range(len(arriving) - 1)]
    assert min(steps) > 0.5 * max(steps) > 0.0
    assert lines[-1]["lambda"] == pytest.approx(DISTORTION, abs=0.02)
    stds = [line["lambda_std"] for line in lines if line["lambda_std"] is not None]
    assert stds[-1] < stds[0]

    assert rdstitch("mosaic", folder, "-o", whole, *FAST).status == 0
    assert whole.read_bytes() == output.read_bytes()
    assert float(rdstitch("mosaic", folder, "-o", whole, "--overwrite", *FAST).out) == pytest.approx(
        last["lambda"], abs=1e-6
    )


def test_an_interrupt_ends_with_what_has_arrived(drive: list[Path], folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "path.csv"
    for picture in drive[:5]:
        shutil.copy(picture, folder)
    process = start("trajectory", folder, "-o", output, "--follow", *FAST)
    names: set[str] = set()
    while len(names) < 5:
        names.add(_line(process)["name"])
    process.send_signal(signal.SIGINT)
    *_, last = _rest(process)
    assert process.returncode == 0
    assert last["frames"] == 5
    assert len(output.read_text(encoding="utf-8").splitlines()) == 6


def test_names_on_standard_input_are_taken_as_they_come(drive: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "path.csv"
    process = start("trajectory", "-", "-o", output, "--follow", *FAST, stdin=subprocess.PIPE)
    assert process.stdin is not None
    for picture in [*drive[:5], tmp_path / "missing.png"]:
        process.stdin.write(f"{picture}\n".encode())
        process.stdin.flush()
        while (line := _line(process))["revised"]:
            pass
        assert line["name"] == picture.name
    *_, last = _rest(process)
    assert process.returncode == 0
    assert last["used"] == 5


def test_a_frame_that_cannot_be_read_has_a_line_with_the_reason(
    rdstitch: Run, drive: list[Path], folder: Path, tmp_path: Path
) -> None:
    for picture in drive[:3]:
        shutil.copy(picture, folder)
    (folder / "frame_0001.png").write_bytes(b"no picture")
    outcome = rdstitch("trajectory", folder, "-o", tmp_path / "path.csv", "--follow", "--idle", "0.1", *FAST)
    lines = [json.loads(line) for line in outcome.out.splitlines()]
    assert lines[1]["name"] == "frame_0001.png"
    assert "no picture" in lines[1]["reason"]
    assert lines[1]["x"] is None


def test_what_would_fail_at_the_end_fails_at_the_beginning(
    rdstitch: Run, drive: list[Path], folder: Path, tmp_path: Path
) -> None:
    outside = tmp_path / "out.png"
    shutil.copy(drive[0], outside)
    assert rdstitch("mosaic", folder, "-o", outside, "--follow").status == 6
    assert rdstitch("mosaic", folder, "-o", tmp_path / "out.xyz", "--follow").status == 6
    assert rdstitch("mosaic", folder, "-o", folder / "out.png", "--follow").status == 2
    (folder.parent / "linked").symlink_to(folder)
    assert rdstitch("mosaic", folder, "-o", tmp_path / "linked" / "out.png", "--follow").status == 2
    used = tmp_path / "used.json"
    used.write_text("{}")
    assert rdstitch("mosaic", folder, "-o", tmp_path / "new.png", "--follow", "--save-camera", used).status == 6
    assert rdstitch("trajectory", folder, "-o", tmp_path / "new.csv", "--follow", "--plot", used).status == 6
    assert rdstitch("mosaic", folder, drive[0], "-o", tmp_path / "other.png", "--follow").status == 2
    assert rdstitch("mosaic", tmp_path / "none", "-o", tmp_path / "other.png", "--follow").status == 3
    refused = rdstitch("mosaic", folder, "-o", tmp_path / "other.png", "--follow", "--idle", "0.05")
    assert refused.status == 3
    assert "no pictures" in refused.line


def test_a_picture_of_the_users_with_the_name_of_the_preview_stays(
    rdstitch: Run, drive: list[Path], folder: Path, tmp_path: Path
) -> None:
    own = tmp_path / "out.preview.jpg"
    own.write_bytes(b"a picture of the user's")
    refused = rdstitch("mosaic", folder, "-o", tmp_path / "out.png", "--follow", "--idle", "0.05")
    assert refused.status == 6
    assert own.name in refused.line
    # It may be replaced, but what was never replaced is not removed.
    forced = rdstitch("mosaic", folder, "-o", tmp_path / "out.png", "--follow", "--idle", "0.05", "--overwrite")
    assert forced.status == 3
    assert own.read_bytes() == b"a picture of the user's"
