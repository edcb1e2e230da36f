"""Maps, bags and poses for other programs: refused where they would be wrong or too large, and whole or not at all."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from rdstitch.errors import ArgumentError, LimitError, OutputError
from rdstitch.export.map_server import write_map
from rdstitch.export.poses_files import poses_file
from rdstitch.export.trajectory_files import path_as_svg, write_trajectory
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.lens_model import LensModel
from rdstitch.inputs.rosbag import opened_bag
from rdstitch.io.read import read_image
from rdstitch.io.write import write_image
from rdstitch.results.pose import FollowedPoses, Pose
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.outputs import Outputs
from rdstitch.tracking import TrackingResult
from rdstitch.tracking.placement import Placement
from rdstitch.trajectories.trajectory import Trajectory
from tests.registrations import registration, source, stitched

PATH = Trajectory(np.arange(2), np.zeros((2, 2)), np.zeros(2), np.ones(2))


def test_the_memory_of_a_map_is_that_of_the_turned_strip(tmp_path: Path) -> None:
    """It is refused before the image, which is not there, is decoded."""
    strip = stitched(registration(2), tmp_path / "strip.png", max_memory=3 * 10**6)
    poses = strip.registration.alignment.poses
    turned = replace(poses, yaw=poses.yaw + np.pi / 4)
    alignment = replace(strip.registration.alignment, poses=turned)
    registered = replace(strip.registration, alignment=alignment)
    strip = replace(strip, registration=registered, canvas=replace(strip.canvas, size=(6000, 60)))
    with pytest.raises(LimitError, match=r"map of 42[89]\d x 42[89]\d pixels"), Outputs(overwrite=False) as outputs:
        write_map(strip, tmp_path, 1.0, outputs)


def test_a_map_of_deep_images_has_all_greys_of_what_they_show(tmp_path: Path) -> None:
    """What is beside the images is 0, and far from what a thermal camera measures."""
    strip = stitched(registration(2), tmp_path / "strip.png")
    width, height = strip.canvas.size
    samples = np.zeros((height, width, 2), dtype=np.uint16)
    samples[20:-20, 20:-20] = 21_000, 65_535
    samples[20 : height // 2, 20:-20, 0] = 20_000
    write_image(strip.output, samples[..., 0], (samples[..., 1] // 257).astype(np.uint8))
    with Outputs(overwrite=False) as outputs:
        outputs.make_folder(tmp_path / "map")
        write_map(strip, tmp_path / "map", 1.0, outputs)
    written = read_image(tmp_path / "map" / "map.png")
    shown = written.pixels[written.alpha == 255]
    assert min(np.mean(shown < 5), np.mean(shown > 250)) > 0.4


def _result(names: list[str], cameras: list[Camera]) -> StitchResult:
    return stitched(registration([source(name) for name in names], cameras=tuple(cameras)))


CAMERA = Camera((640, 480), -0.1, focal=500.0)


@pytest.mark.parametrize(
    "other",
    [
        Camera((480, 640), -0.1, focal=500.0),
        replace(CAMERA, focal=800.0),
        replace(CAMERA, distortion=0.0),
        replace(CAMERA, lens_model=LensModel((500.0, 505.0), CAMERA.center, (0.1,) * 4)),
    ],
)
def test_images_of_two_cameras_are_not_given_one(other: Camera) -> None:
    with pytest.raises(ArgumentError, match=r"images\.txt: the images are of several cameras"):
        poses_file(_result(["a.jpg", "b.jpg"], [CAMERA, other]), "images.txt")
    same = poses_file(_result(["a.jpg", "b.jpg"], [CAMERA, replace(CAMERA, tilt=(0.1, 0.0))]), "images.txt")
    assert [line.split()[-2:] for line in same.splitlines()[1::2]] == [["1", "a.jpg"], ["1", "b.jpg"]]


def test_an_image_that_is_left_out_needs_no_camera_of_colmap() -> None:
    sources = [source("a.jpg"), source("b.jpg"), source("left out.jpg", orientation=6)]
    poses, used = registration(sources).alignment.poses, np.array([True, True, False])
    poses = replace(poses, yaw=np.where(used, poses.yaw, np.nan))
    cameras = (CAMERA, CAMERA, CAMERA.turned(6))
    text = poses_file(stitched(registration(sources, cameras=cameras, used=used, poses=poses)), "images.txt")
    assert [line.split()[-1] for line in text.splitlines()[1::2]] == ["a.jpg", "b.jpg"]


@pytest.mark.parametrize("file", ["images.txt", "geo.txt"])
def test_names_that_other_programs_would_cut_are_refused(file: str) -> None:
    with pytest.raises(ArgumentError, match=rf"{file}: names end at blanks there; rename a b\.jpg"):
        poses_file(_result(["a b.jpg", "b.jpg"], [CAMERA, CAMERA]), file)


@pytest.mark.parametrize(("frames", "arrows"), [(1, 1), (40, 40), (41, 40), (79, 40), (500, 40)])
def test_a_path_has_forty_arrows_at_most(frames: int, arrows: int) -> None:
    path = Trajectory(
        np.arange(frames), np.random.default_rng(0).random((frames, 2)), np.zeros(frames), np.ones(frames)
    )
    assert path_as_svg(path).count("<line ") == arrows


def test_a_bag_is_one_of_the_outputs(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    bag = tmp_path / "odom"

    def write(*, overwrite: bool, meanwhile: Callable[[], object]) -> None:
        with Outputs(overwrite) as outputs:
            write_trajectory(PATH, bag, "bag", None, outputs)
            meanwhile()

    def appear() -> None:
        bag.mkdir()
        (bag / "metadata.yaml").write_text("mine")

    with pytest.raises(OutputError, match="later"):
        write(overwrite=True, meanwhile=Mock(side_effect=OutputError("later")))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OutputError, match="appeared during the run"):
        write(overwrite=False, meanwhile=appear)
    assert [file.read_text() for file in bag.iterdir()] == ["mine"]
    (bag / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="not a ROS bag"):
        write(overwrite=True, meanwhile=list)
    (bag / "thesis.txt").unlink()
    write(overwrite=True, meanwhile=list)
    with opened_bag(bag) as reader:
        assert reader.message_count == len(PATH)
    assert [item.name for item in tmp_path.iterdir()] == ["odom"]


@pytest.mark.parametrize("bag", ["odom", "odom.bag"])
def test_a_bag_has_times_until_2038(tmp_path: Path, bag: str) -> None:
    pytest.importorskip("rosbags")
    for second in (2**31 - 1, -(2**31) + 1):
        with Outputs(overwrite=True) as outputs:
            write_trajectory(replace(PATH, timestamp=np.array([0.0, second])), tmp_path / bag, "bag", None, outputs)
    with pytest.raises(OutputError, match=f"{bag}: a bag has no time of 5000000000 s"), Outputs(True) as outputs:
        write_trajectory(replace(PATH, timestamp=np.array([0.0, 5e9])), tmp_path / bag, "bag", None, outputs)


@pytest.mark.parametrize("error", [LimitError("large"), ArgumentError("wrong"), MemoryError()])
def test_what_is_no_fault_of_the_bag_is_not_called_one(tmp_path: Path, error: Exception) -> None:
    pytest.importorskip("rosbags")
    with Outputs(overwrite=False) as outputs:
        write_trajectory(PATH, tmp_path / "odom.bag", "bag", None, outputs)
    with pytest.raises(type(error)), opened_bag(tmp_path / "odom.bag"):
        raise error


@pytest.mark.parametrize(("height", "unit"), [(None, 0.5), (2.0, 0.5), (2.0, None)])
def test_a_height_by_odometry_is_as_sure_as_all_its_lengths_and_those_of_the_images(
    height: float | None, unit: float | None
) -> None:
    away = Placement(CAMERA, np.array([[1.0, 0.0, 3.0], [0.0, 1.0, 4.0], [0.0, 0.0, 1.0]]), 1.0)
    tracked = TrackingResult(placement=away, covariance=np.zeros((4, 4)), length_std=0.3, unit=unit, unit_std=0.1)
    pose = Pose("a.jpg", 1, 0.0, tracked, poses=FollowedPoses(height))
    std = np.sqrt(np.diag(pose.ros_covariance))[:3]
    x, y, z = np.abs(pose.position)
    expected = [0.3 * x, 0.3 * y, 0.0] if height else [0.1 * x, 0.1 * y, np.hypot(0.1, 0.3) * z]
    np.testing.assert_allclose(std, expected)
