"""``rdstitch mosaic``, run for real."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from examples.judging import alignment_error
from rdstitch.matching.two_view_rounds import Pairing
from rdstitch.synthetic import Sequence
from tests.cli.running import CACHED, DISTORTION, Run, finished, start, transfers
from tests.sampled import sampled


def test_a_folder_becomes_one_rectified_image(
    rdstitch: Run, frames: list[Path], sequence: Sequence, tmp_path: Path
) -> None:
    done = rdstitch("mosaic", frames[0].parent, "-o", tmp_path / "mosaic.tif", *CACHED, err="")
    assert abs(float(done.out) - DISTORTION) < 0.01
    record = json.loads((tmp_path / "mosaic.tif.json").read_text(encoding="utf-8"))
    assert alignment_error(sequence, transfers(record), model="homography").median < 1.0
    poses = [image["pose"] for image in record["images"]]
    assert all(set(pose) == {"x", "y", "height", "yaw_deg", "tilt_deg", "covariance"} for pose in poses)
    true = sequence.poses.yaw - sequence.poses.yaw[[i["name"] for i in record["images"]].index(record["reference"])]
    np.testing.assert_allclose([pose["yaw_deg"] for pose in poses], np.degrees(true), atol=0.5)


@pytest.mark.parametrize("how", sampled(["nul", "list", "pattern", "files", "newlines"], 3))
def test_every_way_to_name_images(frames: list[Path], tmp_path: Path, how: str) -> None:
    names, data = [str(path) for path in frames], None
    listing = tmp_path / "list.txt"
    listing.write_text("\n".join(names), encoding="utf-8")
    inputs = {"files": names, "pattern": [f"{frames[0].parent}/frame_*.png"], "list": [f"@{listing}"]}.get(how, ["-"])
    if inputs == ["-"]:
        data = ("\n" if how == "newlines" else "\0").join(names).encode()
    process = start("mosaic", *inputs, "-o", tmp_path / "mosaic.jpg", "--scale", "0.5", *CACHED, stdin=-1)
    assert finished(process, data).status == 0
    record = json.loads((tmp_path / "mosaic.jpg.json").read_text(encoding="utf-8"))
    assert [image["name"] for image in record["images"]] == [path.name for path in frames]


def test_an_unreadable_image_is_left_out_by_name(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    shutil.copytree(frames[0].parent, folder)
    broken = folder / "broken.png"
    broken.write_bytes(frames[0].read_bytes()[:2000])
    rdstitch("mosaic", folder, "-o", tmp_path / "mosaic.jpg", *CACHED, told=str(broken))
    record = json.loads((tmp_path / "mosaic.jpg.json").read_text(encoding="utf-8"))
    assert {image["name"]: image["used"] for image in record["images"]} == {
        "broken.png": False,
        **{path.name: True for path in frames},
    }


def test_its_own_output_is_no_input(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    shutil.copytree(frames[0].parent, folder)
    arguments = ("mosaic", folder, "-o", folder / "mosaic.png", "--overwrite", *CACHED)
    first, second = rdstitch(*arguments), rdstitch(*arguments)
    assert (first.status, first.err, first.out) == (second.status, second.err, second.out) == (0, "", first.out)


def test_a_camera_that_stands_still_for_a_while(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    paused = [shutil.copy(frames[0], tmp_path / f"frame_0000_{again}.png") for again in range(2)]
    done = rdstitch("mosaic", *paused, *frames, "-o", tmp_path / "out.png", "--strict", *CACHED, err="")
    assert abs(float(done.out) - DISTORTION) < 0.005


@pytest.mark.parametrize(
    "glance",
    [
        lambda _, pairs: dict.fromkeys(pairs),
        lambda _, pairs: {},
        lambda _, pairs: dict.fromkeys(pair for pair in pairs if 2 not in pair),
    ],
    ids=["everything looks promising", "nothing does", "one image does not"],
)
def test_every_image_finds_its_place_whatever_the_prescreen_does(
    rdstitch: Run,
    frames: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    glance: Callable[[Pairing, list[tuple[int, int]]], dict[tuple[int, int], None]],
) -> None:
    monkeypatch.setattr(Pairing, "prescreen_pairs", glance)
    rdstitch("mosaic", *frames, "-o", tmp_path / "out.png", "--strict", *CACHED)
