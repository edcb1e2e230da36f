"""``--follow``: a line for each frame as it arrives, and in the end what a run over the whole folder gives."""

import csv
import json
import os
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from rdstitch.inputs.arrivals import Arrivals
from rdstitch.io.read import read_image
from rdstitch.io.write import write_image
from rdstitch.options import StitchOptions
from rdstitch.pipeline.follow import follow
from tests.cli.running import DISTORTION, FAST, Run, flight, start


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Nine images along a line."""
    return flight(5, 9, overlap=0.6).write(tmp_path_factory.mktemp("drive"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where the images arrive."""
    made = tmp_path / "incoming"
    made.mkdir()
    return made


def _written_as(image: Path, file: Path) -> Path:
    write_image(file, read_image(image).pixels)
    return file


def _line(process: "subprocess.Popen[bytes]") -> dict[str, Any]:
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, process.stderr.read().decode() if process.stderr else ""
    record: dict[str, Any] = json.loads(line)
    return record


def _rest(process: "subprocess.Popen[bytes]") -> list[dict[str, Any]]:
    output, _ = process.communicate(timeout=300)
    return [json.loads(line) for line in output.splitlines()]


def test_a_growing_folder_gives_poses_at_once_and_then_the_same_image(
    rdstitch: Run, drive: list[Path], folder: Path, tmp_path: Path
) -> None:
    output, whole = tmp_path / "live.png", tmp_path / "whole.png"
    process = start("mosaic", folder, "-o", output, "--follow", "--idle", "4", "--refresh", "0.1", *FAST)
    lines = []
    arriving = drive[:6]
    for image in arriving:
        shutil.copy(image, folder)
        # Each line comes before the next image does.
        while (line := _line(process))["revised"]:
            lines.append(line)
        assert line["name"] == image.name
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

    rdstitch("mosaic", folder, "-o", whole, *FAST)
    assert whole.read_bytes() == output.read_bytes()
    assert float(rdstitch("mosaic", folder, "-o", whole, "--overwrite", *FAST).out) == pytest.approx(
        last["lambda"], abs=1e-6
    )


def test_an_interrupt_ends_with_what_has_arrived(drive: list[Path], folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "path.csv"
    for image in drive[:5]:
        shutil.copy(image, folder)
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
    for image in [*drive[:5], tmp_path / "missing.png"]:
        process.stdin.write(f"{image}\n".encode())
        process.stdin.flush()
        while (line := _line(process))["revised"]:
            pass
        assert line["name"] == image.name
    *_, last = _rest(process)
    assert process.returncode == 0
    assert last["used"] == 5


@pytest.mark.parametrize("frame", ["enu", "camera"])
def test_lines_have_the_units_and_the_times_of_the_table(
    rdstitch: Run, drive: list[Path], folder: Path, tmp_path: Path, frame: str
) -> None:
    for image in drive:
        shutil.copy(image, folder)
    times = tmp_path / "times.csv"
    times.write_text("name,timestamp\n" + "".join(f"{p.name},{50 + k / 4}\n" for k, p in enumerate(drive)))
    output = tmp_path / "path.csv"
    known = ("--height", "0.42", "--timestamps", times, "--frame", frame, "--focal", "380", *FAST)
    done = rdstitch("trajectory", folder, "-o", output, "--follow", "--idle", "0.1", *known)
    lines = [json.loads(line) for line in done.out.splitlines()][:-1]
    live = {line["name"]: line for line in lines if line["x"] is not None}
    with output.open(encoding="utf-8", newline="") as stream:
        table = list(csv.DictReader(stream))
    assert [row["name"] for row in table] == sorted(live)
    for row in table:
        line = live[row["name"]]
        assert line["timestamp"] == float(row["timestamp"]) >= 50.0
        for key, within in (("x", 0.01), ("y", 0.01), ("height", 0.01), ("yaw_deg", 0.5)):
            assert line[key] == pytest.approx(float(row[key]), abs=within)
    assert abs(float(table[-1]["y"])) > 0.03
    assert float(table[0]["height"]) == pytest.approx(0.42)


def test_a_frame_that_cannot_be_read_has_a_line_with_the_reason(
    rdstitch: Run, drive: list[Path], folder: Path, tmp_path: Path
) -> None:
    for image in drive[:3]:
        shutil.copy(image, folder)
    (folder / "frame_0001.png").write_bytes(b"no image")
    outcome = rdstitch("trajectory", folder, "-o", tmp_path / "path.csv", "--follow", "--idle", "0.1", *FAST)
    lines = [json.loads(line) for line in outcome.out.splitlines()]
    assert [line["name"] for line in lines[:3]] == ["frame_0000.png", "frame_0002.png", "frame_0001.png"]
    assert lines[2]["frame"] == 1
    assert "no image" in lines[2]["reason"]
    assert lines[2]["x"] is None


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_a_file_whose_writer_pauses_is_read_when_it_is_whole(drive: list[Path], folder: Path, suffix: str) -> None:
    whole = [_written_as(image, folder.parent / f"{image.stem}{suffix}").read_bytes() for image in drive[:3]]
    arrivals = Arrivals(folder, frames_folder=Path, idle=2.0)
    frames = follow(arrivals, StitchOptions(workers=1), comes_again=arrivals.comes_again)
    (folder / f"a{suffix}").write_bytes(whole[0])
    assert next(frames).name == f"a{suffix}"

    def write_slowly() -> None:
        for share in (0.01, 0.5, 0.9, 1.0):
            (folder / f"b{suffix}").write_bytes(whole[1][: int(share * len(whole[1]))])
            time.sleep(0.8)
        (folder / f"c{suffix}").write_bytes(whole[2])

    writer = threading.Thread(target=write_slowly)
    writer.start()
    found = [(frame.name, frame.number, bool(frame.tracked and frame.tracked.inliers > 100)) for frame in frames]
    writer.join()
    assert found[:2] == [(f"b{suffix}", 1, True), (f"c{suffix}", 2, True)]


def test_a_file_that_is_mended_after_it_was_reported_is_read(drive: list[Path], folder: Path) -> None:
    for image in drive[:2]:
        shutil.copy(image, folder)
    (bad := folder / "z.png").write_bytes(drive[2].read_bytes()[:9000])
    os.utime(bad, (0, 0))
    arrivals = Arrivals(folder, frames_folder=Path, idle=2.0)
    reasons = []
    for frame in follow(arrivals, StitchOptions(workers=1), comes_again=arrivals.comes_again):
        if frame.name == "z.png":
            reasons.append(frame.reason)
            shutil.copy(drive[2], bad)
    assert len(reasons) == 2
    assert reasons[0]
    assert reasons[1] in ("", "the first frames wait for others")
