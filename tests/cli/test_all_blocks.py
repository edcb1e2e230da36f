"""``rdstitch mosaic --all-blocks``: each block of images that overlap is a result of its own."""

import json
import shutil
from pathlib import Path

import pytest

from tests.cli.running import DISTORTION, FAST, Run, flight


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three images of one floor, two of another, and one of nothing that they show."""
    made = tmp_path_factory.mktemp("blocks")
    for name, seed, count in (("a", 5, 3), ("b", 9, 2), ("c", 14, 1)):
        for path in flight(seed, count, overlap=0.6).write(tmp_path_factory.mktemp(name)):
            shutil.copy(path, made / f"{name}_{path.name}")
    return made


def test_each_block_has_a_file_and_is_named(rdstitch: Run, folder: Path, tmp_path: Path) -> None:
    done = rdstitch("mosaic", folder, "-o", tmp_path / "floor.png", "--all-blocks", "--lambda", str(DISTORTION), *FAST)
    lines = [line for line in (*done.err.splitlines(), done.made) if "pixels" in line]
    for name, block, count, line in zip(("floor", "floor-2"), "ab", (3, 2), lines, strict=True):
        record = json.loads((tmp_path / f"{name}.png.json").read_text(encoding="utf-8"))
        used = [image["name"] for image in record["images"] if image["used"]]
        assert len(used) == count
        assert all(image[0] == block and image in line for image in used)
    assert not (tmp_path / "floor-3.png").exists()
    # What is in another block is not called left out; what is in none is, once.
    assert [line.count(".png") for line in done.err.splitlines() if "left out" in line] == [1]
    assert "left out" in done.err
    assert "c_" in done.err
