"""Paths: frames, units, files and errors."""

from dataclasses import replace

import numpy as np
import pytest

from rdstitch.alignment.result import PlanarPoses
from rdstitch.alignment.trajectory import Trajectory, compare_trajectories
from rdstitch.errors import ArgumentError
from rdstitch.export.trajectory_files import as_csv, as_tum


def _poses() -> PlanarPoses:
    yaw = np.array([0.3, 0.5, np.nan, 3.0, -3.0])
    position = np.array([[1.0, 2.0], [2.0, 2.5], [np.nan, np.nan], [3.0, 2.0], [4.0, 1.0]])
    height = np.array([2.0, 2.2, np.nan, 1.8, 2.0])
    return PlanarPoses(yaw, position, height, np.zeros((5, 2)))


def test_a_path_starts_at_the_origin_with_the_height_given() -> None:
    path = Trajectory.from_poses(_poses(), height=1.5)
    assert path.frame.tolist() == [0, 1, 3, 4]
    np.testing.assert_allclose(path.position[0], 0.0, atol=1e-15)
    np.testing.assert_allclose(path.height, np.array([2.0, 2.2, 1.8, 2.0]) * 0.75)
    assert path.yaw[0] == 0.0
    assert np.abs(np.diff(path.yaw)).max() < np.pi
    # as the first frame sees it: Rz(yaw) (t - t0)
    c, s = np.cos(0.3), np.sin(0.3)
    np.testing.assert_allclose(path.position[1], np.array([[c, -s], [s, c]]) @ [1.0, 0.5] * 0.75)


def test_files() -> None:
    path = Trajectory.from_poses(_poses())
    header, *rows = as_csv(path).splitlines()
    assert header == "frame,name,source_frame,timestamp,x,y,phi_deg,height"
    numbers = np.array([[float(value or "nan") for value in row.split(",")] for row in rows])
    np.testing.assert_allclose(numbers[:, 4:6], path.position, atol=1e-8)
    np.testing.assert_allclose(numbers[:, 6], np.degrees(path.yaw), atol=1e-6)
    timed = replace(path, timestamp=np.array([0.0, 0.1, 0.3, 0.4]))
    tum = np.array([[float(value) for value in row.split()] for row in as_tum(timed).splitlines()])
    assert tum.shape == (4, 8)
    np.testing.assert_allclose(tum[:, 0], [0.0, 0.1, 0.3, 0.4])
    np.testing.assert_allclose(tum[:, 3], -path.height, atol=1e-8)
    np.testing.assert_allclose(
        np.remainder(2 * np.arctan2(tum[:, 6], tum[:, 7]) + path.yaw, 2 * np.pi) % 6.28318, 0, atol=1e-4
    )
    assert [row.split()[0] for row in as_tum(path).splitlines()] == ["0.000000", "1.000000", "3.000000", "4.000000"]


def test_neither_frame_nor_unit_matter_to_the_error() -> None:
    truth = Trajectory.from_poses(_poses())
    p, c, s = _poses(), np.cos(0.7), np.sin(0.7)
    moved = PlanarPoses(p.yaw - 0.7, p.position @ np.array([[c, -s], [s, c]]).T * 3 + 5, p.height * 3, p.tilt)
    error = compare_trajectories(Trajectory.from_poses(moved, height=4.0), truth)
    assert error.translation < 1e-12
    assert error.rotation < 1e-12
    assert error.drift < 1e-12
    assert error.scale == pytest.approx(0.25)


def test_known_errors_are_measured() -> None:
    count = 20
    along = np.stack([np.arange(count) * 0.2, np.zeros(count)], axis=1)
    level, height = np.zeros((count, 2)), np.ones(count)
    straight = PlanarPoses(np.zeros(count), along, height, level)
    bent = PlanarPoses(np.linspace(0.0, 0.001 * (count - 1), count), 1.01 * along, height, level)
    error = compare_trajectories(Trajectory.from_poses(bent), Trajectory.from_poses(straight))
    assert error.rotation == pytest.approx(0.001)
    assert error.scale == pytest.approx(1 / 1.01)
    assert error.translation_in_own_unit == pytest.approx(0.0, abs=0.02)
    assert error.translation == pytest.approx(0.01, rel=0.6)


def test_what_makes_no_path() -> None:
    nothing = PlanarPoses(np.full(3, np.nan), np.full((3, 2), np.nan), np.full(3, np.nan), np.zeros((3, 2)))
    with pytest.raises(ArgumentError, match="at least one frame"):
        Trajectory.from_poses(nothing)
    with pytest.raises(ArgumentError, match="height"):
        Trajectory.from_poses(_poses(), height=0.0)
    path = Trajectory.from_poses(_poses())
    with pytest.raises(ArgumentError, match="only 4 frames"):
        compare_trajectories(path, path, step=4)
