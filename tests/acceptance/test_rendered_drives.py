"""A robot's paths over a floor, no setting given: the trajectory against the truth."""

from pathlib import Path

import numpy as np
import pytest

import rdstitch
from examples.judging.trajectories import compare_trajectories
from tests.cli.running import FAST, finished, start
from tests.floor_drives import DISTORTION, PATHS, floor_drive, read_path, true_path


@pytest.mark.slow
@pytest.mark.parametrize("path", PATHS)
def test_drive(path: str, tmp_path: Path) -> None:
    sequence = floor_drive(path, 80, seed=23, overlap=0.75)
    sequence.write(tmp_path)
    found, registration = rdstitch.trajectory([tmp_path])
    assert len(found) == len(sequence)
    error = compare_trajectories(found, true_path(sequence))
    assert error.translation_in_own_unit < 0.001
    assert np.degrees(error.rotation) < 0.02
    assert abs(registration.alignment.distortion - DISTORTION) < 0.001


@pytest.mark.slow
def test_short_drive_by_the_command(tmp_path: Path) -> None:
    sequence = floor_drive("parking", 12, seed=7, size=(320, 240), overlap=0.7)
    frames, output = tmp_path / "frames", tmp_path / "path.csv"
    frames.mkdir()
    sequence.write(frames)
    done = finished(start("trajectory", frames, "-o", output, *FAST))
    assert (done.status, done.err) == (0, "")
    assert abs(float(done.out) - DISTORTION) < 0.001
    found = read_path(output)
    assert len(found) == len(sequence)
    error = compare_trajectories(found, true_path(sequence))
    assert error.translation_in_own_unit < 0.003
    assert error.drift < 0.001
    assert np.degrees(error.rotation) < 0.02
