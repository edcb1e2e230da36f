"""Paths: frames, units, files and errors."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from examples.judging.trajectories import compare_trajectories
from rdstitch.alignment.result import PlanarPoses
from rdstitch.errors import ArgumentError
from rdstitch.export.trajectory_files import as_csv, as_kitti, as_tum, path_as_svg
from rdstitch.geometry.camera import Camera
from rdstitch.synthetic.poses import Poses, texels_of_pixels
from rdstitch.trajectories.trajectory import Trajectory


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


def test_a_path_of_one_frame_has_no_scale_and_one_of_none_can_be_shown() -> None:
    poses = _poses()
    single = replace(poses, yaw=np.where(np.arange(5) == 1, poses.yaw, np.nan))
    path = Trajectory.from_poses(single)
    assert "heights" not in path_as_svg(path)
    assert "heights" in path_as_svg(Trajectory.from_poses(poses))
    none = Trajectory(path.frame[:0], path.position[:0], path.yaw[:0], path.height[:0])
    assert repr(none) == "<Trajectory 0 frames>"


@pytest.mark.parametrize(("frame", "up"), [("enu", 1.0), ("camera", -1.0)])
def test_files_agree_on_yaw_and_on_what_is_up(frame: Literal["enu", "camera"], up: float) -> None:
    path = Trajectory.from_poses(_poses())
    place = np.column_stack([path.position * (1.0, -up), up * path.height])
    header, *rows = as_csv(path, frame).splitlines()
    assert header == "frame,name,source_frame,timestamp,x,y,yaw_deg,height"
    numbers = np.array([[float(value or "nan") for value in row.split(",")] for row in rows])
    np.testing.assert_allclose(numbers[:, 4:6], place[:, :2], atol=1e-8)
    np.testing.assert_allclose(numbers[:, 6:], np.column_stack([np.degrees(path.yaw), path.height]), atol=1e-6)
    timed = replace(path, timestamp=np.array([0.0, 0.1, 0.3, 0.4]))
    tum = np.array([[float(value) for value in row.split()] for row in as_tum(timed, frame).splitlines()])
    kitti = np.array([[float(value) for value in row.split()] for row in as_kitti(path, frame).splitlines()])
    assert tum.shape == (4, 8)
    np.testing.assert_allclose(tum[:, 0], [0.0, 0.1, 0.3, 0.4])
    np.testing.assert_allclose(tum[:, 1:4], place, atol=1e-8)
    np.testing.assert_allclose(kitti.reshape(-1, 3, 4)[:, :, 3], place, atol=1e-8)
    # Counterclockwise from above: about z where that points up.
    turned = [Rotation.from_quat(tum[:, 4:]), Rotation.from_matrix(kitti.reshape(-1, 3, 4)[:, :, :3])]
    for rotation in turned:
        np.testing.assert_allclose(
            rotation.as_rotvec(), np.outer(up * np.angle(np.exp(1j * path.yaw)), [0, 0, 1]), atol=1e-7
        )
    assert [row.split()[0] for row in as_tum(path, frame).splitlines()] == [f"{k}.000000" for k in (0, 1, 3, 4)]


def test_a_camera_that_turns_left_and_goes_where_its_top_points_has_positive_yaw() -> None:
    lens = Camera((400, 300), focal=300.0)
    turn = np.radians([0.0, 90.0])
    # In the first image the ground of the second lies towards its top; there x of the plane points to the bottom.
    poses = Poses.of([(0.0, 0.0), (0.0, -50.0)], 300.0, turn)
    right, left = texels_of_pixels(lens, poses.from_plane()[1], [(399.0, 149.5), (0.0, 149.5)])
    assert right[1] < left[1]  # the right of the turned image is the top of the first
    table = as_csv(Trajectory.from_poses(PlanarPoses(turn, poses.position, poses.height, poses.tilt)), "enu")
    x, y, yaw, _ = (float(value) for value in table.splitlines()[2].split(",")[4:])
    assert x == 0.0
    assert y > 0.0
    assert yaw == pytest.approx(90.0)


def test_known_errors_are_measured_to_which_neither_frame_nor_unit_matter() -> None:
    p, c, s = _poses(), np.cos(0.7), np.sin(0.7)
    moved = PlanarPoses(p.yaw - 0.7, p.position @ np.array([[c, -s], [s, c]]).T * 3 + 5, p.height * 3, p.tilt)
    error = compare_trajectories(Trajectory.from_poses(moved, height=4.0), Trajectory.from_poses(p))
    assert max(error.translation, error.rotation, error.drift) < 1e-12
    assert error.scale == pytest.approx(0.25)
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


def test_arrays_of_a_path_have_one_shape_a_kind() -> None:
    for position, yaw in ((np.zeros((0, 2)), np.zeros(3)), (np.zeros((3, 3)), np.zeros(3)), (np.zeros((3, 2)), [])):
        with pytest.raises(ArgumentError, match="of a trajectory of 3 frames"):
            Trajectory(np.arange(3), np.asarray(position), np.asarray(yaw), np.zeros(3))
