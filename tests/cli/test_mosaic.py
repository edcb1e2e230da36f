"""``rdstitch mosaic``: of several blocks, with images left out, and when it warns."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.judging import alignment_error
from rdstitch.errors import LimitError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.find import FoundImages
from rdstitch.io.read import read_image
from rdstitch.io.write import write_image
from rdstitch.matching import candidate_pairs
from rdstitch.matching.pair_estimator import PairEstimator
from rdstitch.pipeline import blocks
from rdstitch.pipeline.recipes import stitch_images
from rdstitch.pipeline.registration import accept
from rdstitch.results.messages import Message
from rdstitch.results.stitch_result import StitchResult
from rdstitch.synthetic import RenderedSequence
from rdstitch.verification.findings import Kind
from tests.cli.running import CACHED, DISTORTION, FAST, Run, finished, flight, sidecar_of, start, transfers
from tests.registrations import finding
from tests.sampled import sampled


def test_a_folder_becomes_one_image(
    rdstitch: Run, frames: list[Path], sequence: RenderedSequence, tmp_path: Path
) -> None:
    done = rdstitch("mosaic", frames[0].parent, "-o", tmp_path / "mosaic.tif", *CACHED, err="")
    assert abs(float(done.out) - DISTORTION) < 0.01
    record = sidecar_of(tmp_path / "mosaic.tif")
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
    assert [image["name"] for image in sidecar_of(tmp_path / "mosaic.jpg")["images"]] == [path.name for path in frames]


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
    glance: Callable[[PairEstimator, list[tuple[int, int]]], dict[tuple[int, int], None]],
) -> None:
    monkeypatch.setattr(candidate_pairs, "prescreen_pairs", glance)
    rdstitch("mosaic", *frames, "-o", tmp_path / "out.png", "--strict", *CACHED)


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
        used = [image["name"] for image in sidecar_of(tmp_path / f"{name}.png")["images"] if image["used"]]
        assert len(used) == count
        assert all(image[0] == block and image in line for image in used)
    assert not (tmp_path / "floor-3.png").exists()
    # What is in another block is not called left out; what is in none is, once.
    assert [line.count(".png") for line in done.err.splitlines() if "left out" in line] == [1]
    assert "left out" in done.err
    assert "c_" in done.err


def test_all_blocks_are_planned_first_and_published_together(rdstitch: Run, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "flight")
    (tmp_path / "flight" / "z_broken.png").write_bytes(b"no image")
    first = min(path.name for path in folder.iterdir())
    how = [
        *("mosaic", tmp_path / "flight", "-o", tmp_path / "floor.png", "--all-blocks", "--lambda", DISTORTION, *CACHED),
        *(part for pattern in ("a*", "b*", "z*") for part in ("--include-only", pattern)),
        *("--exclude", "*_frame_0002.png", "--reference", first, "--rectangle", "50,50,350,50,350,250,50,250"),
    ]
    (tmp_path / "floor-2.png").write_bytes(b"mine")
    rdstitch(*how, status=6, told="floor-2.png: exists already")
    assert {file.name for file in tmp_path.iterdir()} == {"flight", "floor-2.png"}
    (tmp_path / "floor-2.png").unlink()
    rdstitch(*how, told="z_broken.png")
    names = {"floor.png", "floor.png.json", "floor-2.png", "floor-2.png.json"}
    assert {file.name for file in tmp_path.iterdir()} == {"flight", *names}


def test_a_cache_that_blocks_have_for_themselves_is_no_option(rdstitch: Run, place: Path) -> None:
    rdstitch("mosaic", place, "-o", place / "out.png", "--all-blocks", *FAST)
    assert sidecar_of(place / "out.png")["options"]["cache"] is None


def test_a_block_that_cannot_be_laid_out_is_told_of(
    rdstitch: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stitched(found: FoundImages, *arguments: Any, **files: Any) -> StitchResult:
        if len(found.frames) < 4:
            raise LimitError("the canvas is too large")
        return stitch_images(found, *arguments, **files)

    monkeypatch.setattr(blocks, "stitch_images", stitched)
    how = ("mosaic", folder, "-o", tmp_path / "floor.png", "--all-blocks", "--lambda", DISTORTION)
    rdstitch(*how, *CACHED, told="no blocks after the 1 first: the canvas is too large")


@pytest.fixture
def spoiled(tmp_path: Path) -> list[Path]:
    """Five images in a row; the last shows other ground, but for a patch by which it is registered."""
    frames = flight(3, 5).write(tmp_path, "frame_{}.png")
    true = read_image(frames[4]).pixels
    image = flight(29, 5).frame(4).copy()
    height, width = image.shape[:2]
    patch = np.s_[height // 3 : height // 3 + 72, width // 8 : width // 8 + 72]
    image[patch] = true[patch]
    write_image(frames[4], image)
    return frames


@pytest.mark.parametrize("strict", [False, True])
def test_what_fails_its_checks_is_left_out(rdstitch: Run, spoiled: list[Path], tmp_path: Path, strict: bool) -> None:
    extra = ("--strict",) if strict else ()
    done = rdstitch("mosaic", *spoiled, "-o", tmp_path / "out.png", *CACHED, *extra, status=5 if strict else 0)
    assert f"left out {spoiled[4]}" in done.err
    assert not any(f"left out {path}" in done.err for path in spoiled[:4])
    assert strict or abs(float(done.out) - DISTORTION) < 0.005


def test_images_of_another_block_are_named_in_one_line(rdstitch: Run, tmp_path: Path) -> None:
    own, others = flight(3, 3).write(tmp_path, "a{}.png"), flight(29, 2).write(tmp_path, "b{}.png")
    done = rdstitch("mosaic", *own, *others, "-o", tmp_path / "out.png", *CACHED)
    (line,) = [line for line in done.err.splitlines() if "left out" in line]
    assert f"left out {others[0]}, {others[1].name}: in block 2 of 2, whose 2 images overlap too little" in line


# Without a focal length, a path says that its lengths are guessed.
GIVEN = (*CACHED, "--focal", "380")
OUTPUTS = {"pano": "out.png", "mosaic": "out.png", "calibrate": "camera.json", "trajectory": "path.csv"}


def _pretend(monkeypatch: pytest.MonkeyPatch, *found: Message) -> None:
    findings = tuple(finding(Kind.ERRORS, severity=message.severity) for message in found)
    monkeypatch.setattr(accept, "judge", lambda *arguments, **options: findings)
    monkeypatch.setattr(accept, "messages_of", lambda *arguments: list(found))


@pytest.mark.parametrize("command", OUTPUTS)
def test_what_fails_is_written_with_force_only_and_warnings_are_printed(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    _pretend(monkeypatch, Message("the images disagree", severity="failure"), Message("look at that seam"))
    output = tmp_path / OUTPUTS[command]
    rdstitch(command, *frames, "-o", output, *GIVEN, status=4, told="the images disagree")
    assert not output.exists()
    forced = rdstitch(command, *frames, "-o", output, *GIVEN, "--force").err.splitlines()
    assert output.exists()
    # What calibrate prints of the lens comes after them.
    assert forced[0] == "rdstitch: warning: not reliable: the images disagree"
    assert forced[1] == "rdstitch: warning: look at that seam"


def test_two_images_of_two_lenses_are_noticed(rdstitch: Run, tmp_path: Path) -> None:
    sequence = flight(3, 2)
    assert isinstance(sequence.lens, Camera)
    other = replace(sequence, lens=replace(sequence.lens, distortion=-0.12))
    images = [sequence.write(tmp_path, "own_{}.png")[0], other.write(tmp_path, "other_{}.png")[1]]
    done = rdstitch("pano", *images, "-o", tmp_path / "out.png", *CACHED, status=4)
    found = re.search(
        r"two lenses or zooms are mixed: (\w+\.png) \(λ about (-0\.\d+)\) and (\w+\.png) \((-0\.\d+)\)", done.line
    )
    seen = {found[1]: float(found[2]), found[3]: float(found[4])}
    assert seen == {"own_0.png": pytest.approx(-0.2, abs=0.02), "other_1.png": pytest.approx(-0.12, abs=0.02)}
    assert not (tmp_path / "out.png").exists()


@pytest.mark.parametrize("strict", [False, True])
def test_images_of_two_lenses_are_parted(rdstitch: Run, frames: list[Path], tmp_path: Path, strict: bool) -> None:
    sequence = flight(3, 5)
    assert isinstance(sequence.lens, Camera)
    zoomed = replace(sequence, lens=replace(sequence.lens, distortion=-0.12))
    own, others = sequence.write(tmp_path, "own_{:04d}.png")[:3], zoomed.write(tmp_path, "other_{:04d}.png")[3:]
    extra = ("--strict",) if strict else ()
    done = rdstitch("mosaic", *own, *others, "-o", tmp_path / "out.png", *extra, *CACHED, status=5 if strict else 0)
    assert all(path.name in done.err for path in others)
    assert not any(path.name in done.err for path in own)
    assert re.search(
        r"another lens or zoom setting \(λ about -0\.1[12]\d, that of the others -0\.(19|20)\d\)", done.err
    )
    assert strict or abs(float(done.out) - DISTORTION) < 0.002
