"""``--follow``: a line for each frame as it arrives, and in the end what a run over the whole folder gives."""

import json
import shutil
import signal
import subprocess
import threading
import time
from contextlib import nullcontext
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rdstitch.inputs import frame_stream
from rdstitch.inputs.frame_stream import open_frame_stream
from rdstitch.io.read import read_image
from rdstitch.io.write import write_image
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.follow import follow
from rdstitch.tracking.preview import LivePreview
from tests.cli.running import DISTORTION, FAST, Run, copied, flight, rows_of, start
from tests.sampled import sampled


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Nine images along a line."""
    return flight(5, 9, overlap=0.6).write(tmp_path_factory.mktemp("drive"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where the images arrive."""
    (made := tmp_path / "incoming").mkdir()
    return made


def _line(process: "subprocess.Popen[bytes]") -> dict[str, Any]:
    line = process.stdout.readline()
    assert line, process.stderr.read().decode() if process.stderr else ""
    record: dict[str, Any] = json.loads(line)
    return record


def _rest(process: "subprocess.Popen[bytes]") -> list[dict[str, Any]]:
    output, _ = process.communicate(timeout=300)
    return [json.loads(line) for line in output.splitlines()]


def test_poses_at_once_and_then_the_same_image(rdstitch: Run, drive: list[Path], folder: Path, tmp_path: Path) -> None:
    output, whole = tmp_path / "live.png", tmp_path / "whole.png"
    process = start("mosaic", folder, "-o", output, "--follow", "--idle", "4", "--refresh", "0.1", *FAST)
    lines = []
    arriving = drive[:7]
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
    copied(drive[:5], folder)
    process = start("trajectory", folder, "-o", output, "--follow", *FAST)
    names: set[str] = set()
    while len(names) < 5:
        names.add(_line(process)["name"])
    process.send_signal(signal.SIGINT)
    *_, last = _rest(process)
    assert process.returncode == 0
    assert last["frames"] == 5
    assert len(output.read_text(encoding="utf-8").splitlines()) == 6


def test_a_reader_of_poses_that_ends_costs_no_frame(drive: list[Path], folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "path.csv"
    process = start("trajectory", folder, "-o", output, "--follow", "--idle", "4", *FAST)
    copied(drive[:3], folder)
    _line(process)
    process.stdout.close()
    copied(drive[3:6], folder)
    said = process.stderr.read().decode()
    process.stderr.close()
    assert process.wait() == 141
    assert said.count("nobody reads the poses any more") == 1
    assert len(output.read_text(encoding="utf-8").splitlines()) == 7


def test_names_on_standard_input_are_taken_as_they_come(drive: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "path.csv"
    process = start("trajectory", "-", "-o", output, "--follow", *FAST, stdin=subprocess.PIPE)
    for image in [*drive[:5], tmp_path / "missing.png"]:
        process.stdin.write(f"{image}\n".encode())
        process.stdin.flush()
        while (line := _line(process))["revised"]:
            pass
        assert line["name"] == image.name
    *_, last = _rest(process)
    assert process.returncode == 0
    assert last["used"] == 5


@pytest.mark.parametrize("frame", sampled(["enu", "camera"]))
def test_lines_are_those_of_the_table(
    rdstitch: Run, drive: list[Path], folder: Path, tmp_path: Path, frame: str
) -> None:
    copied(drive, folder)
    times = tmp_path / "times.csv"
    times.write_text("name,timestamp\n" + "".join(f"{p.name},{50 + k / 4}\n" for k, p in enumerate(drive)))
    output = tmp_path / "path.csv"
    known = ("--height", "0.42", "--timestamps", times, "--frame", frame, "--focal", "380", *FAST)
    done = rdstitch("trajectory", folder, "-o", output, "--follow", "--idle", "0.1", *known)
    lines = [json.loads(line) for line in done.out.splitlines()][:-1]
    live = {line["name"]: line for line in lines if line["x"] is not None}
    table = rows_of(output)
    assert [row["name"] for row in table] == sorted(live)
    for row in table:
        line = live[row["name"]]
        assert line["timestamp"] == float(row["timestamp"]) >= 50.0
        for key, within in (("x", 0.01), ("y", 0.01), ("height", 0.01), ("yaw_deg", 0.5)):
            assert line[key] == pytest.approx(float(row[key]), abs=within)
    assert abs(float(table[-1]["y"])) > 0.03
    assert float(table[0]["height"]) == pytest.approx(0.42)


def test_the_line_of_what_cannot_be_read(rdstitch: Run, drive: list[Path], folder: Path, tmp_path: Path) -> None:
    copied(drive[:3], folder)
    (folder / "frame_0001.png").write_bytes(b"no image")
    outcome = rdstitch("trajectory", folder, "-o", tmp_path / "path.csv", "--follow", "--idle", "0.1", *FAST)
    lines = [json.loads(line) for line in outcome.out.splitlines()]
    assert [line["name"] for line in lines[:3]] == ["frame_0000.png", "frame_0002.png", "frame_0001.png"]
    assert lines[2]["frame"] == 1
    assert "not an image" in lines[2]["reason"]
    assert lines[2]["x"] is None


def test_a_preview_that_cannot_be_written_ends_nothing(drive: list[Path], tmp_path: Path) -> None:
    arrivals = open_frame_stream(drive[0].parent, frames_folder=Path, idle=0.5)
    options, gone = StitchOptions(workers=1, distortion=DISTORTION), tmp_path / "gone" / "preview.jpg"
    poses = list(follow(arrivals, options, preview=LivePreview(gone, 0.0)))
    assert len({pose.name for pose in poses}) == len(drive)
    assert [message.text[:14] for pose in poses for message in pose.messages] == ["no preview any"]


class _Camera:
    """A camera that drops every third frame, and whose connection breaks after the sixth until it is opened again."""

    def __init__(self) -> None:
        self.grabbed = self.opened = 0

    def isOpened(self) -> bool:  # noqa: N802
        return True

    def open(self, _: int | str) -> bool:
        self.opened += 1
        return True

    def get(self, _: int) -> float:
        return -1.0

    def grab(self) -> bool:
        self.grabbed += 1
        return self.grabbed % 3 != 0 and (self.grabbed < 7 or self.opened > 0)

    def retrieve(self) -> tuple[bool, Any]:
        return True, np.full((4, 6, 3), self.grabbed, np.uint8)


@pytest.mark.parametrize("idle", [None, 60.0])
def test_a_stream_goes_on_after_a_lost_frame_and_is_opened_again(
    idle: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = _Camera()
    monkeypatch.setattr(frame_stream, "opened_capture", lambda _: nullcontext(camera))
    monkeypatch.setattr(frame_stream, "_POLL_SECONDS", 0.0)
    monkeypatch.setattr(frame_stream, "_REOPEN_SECONDS", 0.01)
    stream = open_frame_stream("rtsp://camera", frames_folder=lambda: tmp_path, idle=idle)
    assert [frame.number for frame in islice(stream, 7)] == list(range(7))
    assert camera.opened


def test_files_whose_writers_pause_are_read_when_they_are_whole(drive: list[Path], folder: Path) -> None:
    names = ["a.png", "b.jpg", "c.png", "d.tif", "e.png"]
    for name, image in zip(names, drive, strict=False):
        write_image(folder.parent / name, read_image(image).pixels)
    whole = {name: (folder.parent / name).read_bytes() for name in names}
    arrivals = open_frame_stream(folder, frames_folder=Path, idle=2.0)
    frames = follow(arrivals, StitchOptions(workers=1), comes_again=arrivals.comes_again)
    (folder / "a.png").write_bytes(whole["a.png"])
    assert next(frames).name == "a.png"

    def write_slowly() -> None:
        for share in (0.01, 0.5, 0.9, 1.0):
            for name in names[1:4]:
                (folder / name).write_bytes(whole[name][: int(share * len(whole[name]))])
            time.sleep(0.8)
        (folder / "e.png").write_bytes(whole["e.png"])

    writer = threading.Thread(target=write_slowly)
    writer.start()
    found = [(frame.name, frame.number, frame.tracked.inliers > 60) for frame in frames]
    writer.join()
    expected = [(name, number, True) for number, name in enumerate(names)]
    assert found[:3] == expected[1:4]
    assert expected[4] in found
