"""The scripts of examples/batch, run where their tools are."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rdstitch.geometry.camera import Camera
from rdstitch.io.read import read_image
from tests.cli.running import FAST, Outcome, copied
from tests.sampled import sampled

_SCRIPTS = Path(__file__).parents[2] / "examples" / "batch"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """With an ``rdstitch`` in the search path, whatever is installed."""
    folder = tmp_path / "bin"
    folder.mkdir()
    program = folder / "rdstitch"
    program.write_text(f"#!{sys.executable}\nfrom rdstitch_cli.main import main\nmain()\n", encoding="utf-8")
    program.chmod(0o755)
    libraries = os.pathsep.join(path for path in sys.path if path)
    return {
        **os.environ,
        "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": libraries,
        "OMP_NUM_THREADS": "1",
        "JOBS": "1",
    }


@pytest.fixture
def floors(tmp_path: Path, frames: list[Path]) -> Path:
    """Two folders of images, and one that is of no use; names with spaces and quotes."""
    for name, images in {"hall one": frames[:2], "it's two": frames[1:], "empty": []}.items():
        copied(images, tmp_path / "floors" / name)
    return tmp_path / "floors"


def _run(
    environment: dict[str, str], script: str, *arguments: str | Path, needs: tuple[str, ...]
) -> "subprocess.CompletedProcess[str]":
    for tool in ("sh", *needs):
        if shutil.which(tool) is None:
            pytest.skip(f"there is no {tool}")
    command = [_SCRIPTS / script, *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)


def test_mosaics_and_their_summary(environment: dict[str, str], floors: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = _run(environment, "mosaics.sh", floors, out, "--scale", "0.5", *FAST, needs=("find", "xargs"))
    assert done.returncode == 1
    assert f"{floors / 'empty'}: exit status 3" in done.stderr
    made = {path.name: path.stat().st_mtime_ns for path in out.glob("*.tif")}
    assert sorted(made) == ["hall one.tif", "it's two.tif"]
    # What is there is kept, and without the useless folder all is well.
    (floors / "empty").rmdir()
    assert _run(environment, "mosaics.sh", floors, out, needs=("find", "xargs")).returncode == 0
    assert {path.name: path.stat().st_mtime_ns for path in out.glob("*.tif")} == made

    # An image that is not the one that its sidecar names is neither kept in silence nor replaced.
    (out / "hall one.tif").write_bytes(b"half")
    done = _run(environment, "mosaics.sh", floors, out, needs=("find", "xargs", "sha256sum"))
    assert (done.returncode, f"{out / 'hall one.tif'}: is not the image" in done.stderr) == (1, True)
    assert (out / "hall one.tif").read_bytes() == b"half"
    for file in out.glob("hall one.tif*"):
        file.unlink()
    assert _run(environment, "mosaics.sh", floors, out, "--scale", "0.5", *FAST, needs=("find",)).returncode == 0

    table = _run(environment, "summary.sh", out, needs=("find", "xargs", "jq"))
    assert (table.returncode, table.stderr) == (0, "")
    head, *rows = (line.split("\t") for line in table.stdout.splitlines())
    assert [row[head.index("image")] for row in rows] == sorted(made)
    assert [(row[head.index("used")], row[head.index("all")]) for row in rows] == [("2", "2")] * 2
    assert all(-0.3 < float(row[head.index("lambda")]) < -0.1 for row in rows)

    bands = _run(environment, "bands.sh", out / "hall one.tif.json", tmp_path / "bands", floors / "hall one", needs=())
    assert Outcome.of(bands.returncode, bands.stdout, bands.stderr).err == ""
    assert bands.returncode == 0
    made_band = tmp_path / "bands" / "hall one.tif"
    assert read_image(made_band).pixels.shape == read_image(out / "hall one.tif").pixels.shape
    again = _run(environment, "bands.sh", out / "hall one.tif.json", tmp_path / "bands", floors / "hall one", needs=())
    assert (again.returncode, again.stderr) == (0, "")
    Path(f"{made_band}.json").unlink()
    again = _run(environment, "bands.sh", out / "hall one.tif.json", tmp_path / "bands", floors / "hall one", needs=())
    assert (again.returncode, f"{made_band}: is not the image" in again.stderr) == (1, True)


@pytest.mark.parametrize("place", sampled(["floors/straight", "straight"]))
def test_undistorting_a_tree(environment: dict[str, str], floors: Path, tmp_path: Path, place: str) -> None:
    Camera((400, 300), -0.2).save(tmp_path / "camera.json")
    arguments = (tmp_path / "camera.json", floors, tmp_path / place)
    originals = sorted(str(path.relative_to(floors)) for path in floors.rglob("*.png"))
    for _ in range(2):
        done = _run(environment, "undistort_all.sh", *arguments, needs=("find", "xargs", "realpath"))
        assert done.returncode == 0
        assert all("2 images undistorted" in line for line in done.stderr.splitlines())
        made = sorted(str(path.relative_to(tmp_path / place)) for path in (tmp_path / place).rglob("*.png"))
        assert made == originals
