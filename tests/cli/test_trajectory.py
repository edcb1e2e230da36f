"""``rdstitch trajectory``, run for real."""

import csv
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from rdstitch.synthetic import Sequence
from tests.cli.running import CACHED, DISTORTION, Run


def test_csv_holds_the_path(rdstitch: Run, frames: list[Path], sequence: Sequence, tmp_path: Path) -> None:
    known = ("--focal", str(sequence.lens.focal), "--plot", tmp_path / "path.svg")
    done = rdstitch("trajectory", frames[0].parent, "-o", tmp_path / "path.csv", *known, *CACHED, err="")
    assert abs(float(done.out) - DISTORTION) < 0.01
    with (tmp_path / "path.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    place = np.array([[float(row["x"]), float(row["y"])] for row in rows])
    steps = np.linalg.norm(np.diff(place, axis=0), axis=1)
    true = np.linalg.norm(np.diff(sequence.poses.position, axis=0), axis=1)
    np.testing.assert_allclose(steps, true / sequence.poses.height[0], rtol=0.02)
    assert ElementTree.parse(tmp_path / "path.svg").getroot().tag.endswith("svg")


def test_height_scales_positions_and_tum_has_eight_columns(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    arguments = ("trajectory", *frames, "--format", "tum", *CACHED)
    rdstitch(*arguments, "-o", tmp_path / "one.txt", told="lengths may be off")
    rdstitch(*arguments, "-o", tmp_path / "two.txt", "--height", "2")
    first, second = (np.loadtxt(tmp_path / name) for name in ("one.txt", "two.txt"))
    assert first.shape == (3, 8)
    np.testing.assert_allclose(second[:, 1:3], 2.0 * first[:, 1:3], atol=1e-6)
    np.testing.assert_allclose(second[:, 4:], first[:, 4:], atol=1e-9)
