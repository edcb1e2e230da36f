"""Frames of a video exist only while a command runs: every command must have done with them by then."""

from pathlib import Path

import pytest

from rdstitch.io import read_image
from tests.cli.running import DISTORTION, FAST, Run, finished, start
from tests.videos import write_video


@pytest.fixture
def video(frames: list[Path], tmp_path: Path) -> Path:
    return write_video(tmp_path / "drive.avi", (read_image(frame).pixels for frame in frames))


@pytest.mark.parametrize(
    ("command", "output"), [("mosaic", "out.png"), ("calibrate", "camera.json"), ("trajectory", "path.csv")]
)
def test_a_video_is_as_good_as_its_frames(
    rdstitch: Run, video: Path, tmp_path: Path, command: str, output: str
) -> None:
    done = rdstitch(command, video, "-o", tmp_path / output, "--focal", "380", *FAST)
    assert "warning" not in done.err
    assert abs(float(done.out) - DISTORTION) < 0.01
    assert (tmp_path / output).stat().st_size > 0


@pytest.mark.parametrize("following", [(), ("--follow",)])
def test_a_video_is_never_written_over(rdstitch: Run, video: Path, tmp_path: Path, following: tuple[str, ...]) -> None:
    before = video.read_bytes()
    inner, outer = tmp_path / "inner.txt", tmp_path / "outer.txt"
    inner.write_text(f"{video}\n", encoding="utf-8")
    outer.write_text(f"@{inner}\n", encoding="utf-8")
    for named, output in ((video, video), *([] if following else [(f"@{outer}", inner)])):
        rdstitch("trajectory", named, "-o", output, "--overwrite", *following, *FAST, status=6, told="is read as input")
    assert video.read_bytes() == before


@pytest.mark.parametrize("follow", [(), ("--follow", "--idle", "0.1")])
@pytest.mark.parametrize("damage", ["text", "cut"])
def test_nobody_but_rdstitch_writes_on_standard_error(
    frames: list[Path], tmp_path: Path, damage: str, follow: tuple[str, ...]
) -> None:
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no video\n" * 20 if damage == "text" else b"\0\0\0\x18ftypmp42" + bytes(400))
    done = finished(start("trajectory", *follow, str(broken), "-o", str(tmp_path / "path.csv")))
    assert done.status == 3
    assert done.line.startswith(f"rdstitch: {broken}: ")
