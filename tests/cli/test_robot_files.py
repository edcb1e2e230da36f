"""What robots load: a map of nav2, odometry in a bag, all in one frame."""

import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

import rdstitch
from rdstitch.export import map_server
from rdstitch.pipeline import recipes
from rdstitch.pipeline.registration.register import register
from tests.cli.running import CACHED, OPTIONS, Run, rows_of, sidecar_of


def _poses(file: Path) -> np.ndarray[Any, Any]:
    return np.array([[float(row[key]) for key in ("x", "y", "yaw_deg")] for row in rows_of(file)])


def test_map_poses_and_odometry_lie_in_one_frame(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    known = ("--focal", "380", "--height", "0.42", *CACHED)
    rdstitch(
        *("mosaic", *frames, "-o", tmp_path / "floor.png", "--map-server", tmp_path / "maps"),
        *("--poses", tmp_path / "poses.csv", "--frame", "ros", *known),
    )
    rdstitch("trajectory", *frames, "-o", tmp_path / "path.csv", "--frame", "ros", *known)
    poses = _poses(tmp_path / "path.csv")
    np.testing.assert_allclose(_poses(tmp_path / "poses.csv"), poses, atol=1e-4)
    rdstitch("trajectory", *frames, "-o", tmp_path / "enu.csv", *known)
    enu = _poses(tmp_path / "enu.csv")
    np.testing.assert_allclose(poses[:, :2], np.column_stack([enu[:, 1], -enu[:, 0]]), atol=1e-9)

    content = yaml.safe_load((tmp_path / "maps" / "map.yaml").read_text(encoding="utf-8"))
    assert content.keys() >= {"image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"}
    with Image.open(tmp_path / "maps" / content["image"]) as image:
        seen = np.asarray(image.convert("LA"))[..., 1] > 0
    # Below each camera there is floor on the map.
    column, row = ((poses[:, :2] - content["origin"][:2]) / content["resolution"]).astype(int).T
    assert seen[seen.shape[0] - 1 - row, column].all()
    assert content["resolution"] == pytest.approx(0.42 / 380.0, rel=0.2)

    highlevel = pytest.importorskip("rosbags.highlevel")
    as_bag = ("-o", tmp_path / "odom", "--format", "bag")
    rdstitch("trajectory", *frames[:2], *as_bag, *known)
    drive = ("--follow", "--idle", "0.1", "--overwrite")
    rdstitch("trajectory", frames[0].parent, *as_bag, *known, *drive)
    with highlevel.AnyReader([tmp_path / "odom"]) as reader:
        messages = [reader.deserialize(data, connection.msgtype) for connection, _, data in reader.messages()]
    for message, (x, y, yaw) in zip(messages, poses, strict=True):
        at, turn = message.pose.pose.position, message.pose.pose.orientation
        assert (at.x, at.y, at.z) == pytest.approx((x, y, 0.42), abs=1e-3)
        assert 2.0 * math.atan2(turn.z, turn.w) == pytest.approx(math.radians(yaw), abs=1e-6)
        assert message.pose.covariance.shape == (36,)


def test_the_first_image_is_the_frame_of_all_that_is_written(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    known = ("--focal", "380", "--height", "0.42", "--frame", "first", *CACHED)
    rdstitch("trajectory", *frames, "-o", tmp_path / "path.csv", *known)
    beside = ("--poses", tmp_path / "poses.csv", "--map-server", tmp_path / "maps")
    rdstitch("mosaic", *frames, "-o", tmp_path / "f.png", *beside, *known)
    path = _poses(tmp_path / "path.csv")
    np.testing.assert_allclose(_poses(tmp_path / "poses.csv"), path, atol=1e-3)
    poses = [image["pose"] for image in sidecar_of(tmp_path / "f.png")["images"]]
    of_sidecar = np.array([[0.42 * pose["x"], 0.42 * pose["y"], pose["yaw_deg"]] for pose in poses])
    np.testing.assert_allclose(of_sidecar, path, atol=1e-3)
    assert (of_sidecar[0] == 0.0).all()
    refused = ("mosaic", *frames, "-o", tmp_path / "g.png", "--reference", frames[1].name, *beside, *known)
    rdstitch(*refused, status=2, told="reference and frame first both name the reference")


def test_tables_of_poses_have_covariances_without_a_word_to_the_registration(
    frames: list[Path], tmp_path: Path
) -> None:
    beside = rdstitch.FilesBeside(poses=tmp_path / "poses.csv")
    rdstitch.mosaic(frames, tmp_path / "f.png", replace(OPTIONS, focal=380.0), beside=beside)
    assert float(rows_of(tmp_path / "poses.csv")[1]["cov_x_x"]) > 0.0


def test_the_first_image_that_has_a_place_is_the_frame(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another alignment of the same pairs: features and pairs are found once."""
    registered = Mock(side_effect=register)
    monkeypatch.setattr(recipes, "register", registered)
    elsewhere = tmp_path / "0_elsewhere.png"
    cv2.imwrite(str(elsewhere), np.random.default_rng(3).integers(0, 255, (240, 320), dtype=np.uint8))
    beside = ("--poses", tmp_path / "poses.csv", "--focal", "380", "--frame", "first")
    done = rdstitch("mosaic", elsewhere, *frames, "-o", tmp_path / "f.png", *beside, *CACHED, status=None)
    assert "0_elsewhere.png" in done.err
    record = sidecar_of(tmp_path / "f.png")
    first = next(image for image in record["images"] if image["used"])
    assert record["reference"] == first["name"] == frames[0].name
    assert (first["pose"]["x"], first["pose"]["y"], first["pose"]["height"]) == (0.0, 0.0, 1.0)
    registered.assert_called_once()


def test_of_several_bands_the_first_one_is_the_map(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    wanted = ("mosaic", *frames, "-o", tmp_path / "f.png", "--map-server", tmp_path / "maps", "--focal", "380", *CACHED)
    rdstitch(*wanted, status=2, told="--map-server is in metres")
    wanted = (*wanted, "--height", "1")
    second = [shutil.copy(frame, tmp_path / f"b_{frame.name}") for frame in frames]
    rdstitch("mosaic", *second, *wanted[1:], "--bands", "A=frame_*.png,B=b_frame_*.png")
    assert {file.name for file in (tmp_path / "maps").iterdir()} == {"map.yaml", "map.png"}
    rdstitch(*wanted, status=None, told="map.yaml: exists already")
    assert not (tmp_path / "f.png").exists()
    for suffix in (".dzi", ".zarr"):
        tiled = ("mosaic", *frames, "-o", tmp_path / f"f{suffix}", "--map-server", tmp_path / "maps")
        rdstitch(*tiled, status=2, told=f"instead of {suffix}")


def test_what_a_map_needs_costs_no_mosaic(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_server, "default_memory", lambda: 10**6)
    wanted = ("-o", tmp_path / "f.png", "--map-server", tmp_path / "maps", "--height", "1", "--focal", "380")
    rdstitch("mosaic", *frames, *wanted, *CACHED, told="MB of memory")
    assert (tmp_path / "f.png").exists()
    assert not (tmp_path / "maps").exists()


def test_a_folder_that_is_no_bag_is_not_replaced(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "metadata.yaml").write_text("mine", encoding="utf-8")
    (tmp_path / "notes" / "thesis.txt").write_text("mine", encoding="utf-8")
    wanted = ("-o", tmp_path / "notes", "--format", "bag", "--overwrite", *CACHED)
    rdstitch("trajectory", *frames, *wanted, status=6, told="not a ROS bag")
    assert len(list((tmp_path / "notes").iterdir())) == 2


def test_a_bag_is_replaced(rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    highlevel = pytest.importorskip("rosbags.highlevel")
    bag = tmp_path / "odom.bag"
    bag.write_bytes(b"older")
    wanted = ("-o", bag, "--format", "bag", "--focal", "380", "--overwrite", *CACHED)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "rosbags.rosbag1", None)
        rdstitch("trajectory", frames[0], *wanted, status=None, told="pip install")
    assert bag.read_bytes() == b"older"
    rdstitch("trajectory", *frames, *wanted)
    with highlevel.AnyReader([bag]) as reader:
        heads = [reader.deserialize(data, c.msgtype).header for c, _, data in reader.messages()]
    assert [(head.seq, head.frame_id) for head in heads] == [(k, "odom") for k in range(len(frames))]
