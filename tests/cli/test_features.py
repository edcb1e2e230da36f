"""``--features``: every kind gives what the default gives."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import CameraRecord
from rdstitch.system.records import convert
from tests.cli.running import Run, transfers
from tests.sampled import sampled

PAIR = sorted((Path(__file__).resolve().parents[2] / "examples/data/garfield_red").glob("*.jpg"))
# What is looked at is the registration; the image may be small.
SMALL = ("--scale", "0.1", "--blend", "feather", "--seam", "voronoi", "-j", "1")


def stitched(rdstitch: Run, folder: Path, kind: str) -> dict[str, Any]:
    output = folder / f"{kind}.jpg"
    done = rdstitch("pano", *PAIR, "-o", output, "--features", kind, "--reference", PAIR[0].name, *SMALL)
    assert all("[few-images]" in line for line in done.err.splitlines())
    record: dict[str, Any] = json.loads(Path(f"{output}.json").read_text(encoding="utf-8"))
    return record


def overlap(record: dict[str, Any]) -> FloatArray:
    """Where a grid over the second image lies in the first one, px; NaN where it is outside."""
    camera = record["camera"]
    width, height = camera["image_size"]
    lens = convert(camera, CameraRecord, "sidecar").camera()
    u, v = np.meshgrid(np.linspace(0, width - 1, 40), np.linspace(0, height - 1, 30))
    # The frame is that of the first image: its undistorted px are only scaled and shifted.
    first = np.array(record["images"][0]["to_output"])
    first /= first[2, 2]
    flat = (transfers(record)[1](np.column_stack([u.ravel(), v.ravel()])) - first[:2, 2]) / first[0, 0]
    points = lens.distort(lens.denormalize(flat))
    inside = np.asarray((points >= 0) & (points <= (width - 1, height - 1))).all(axis=1, keepdims=True)
    return np.where(inside, points, np.nan)


@pytest.fixture(scope="module")
def default() -> dict[str, Any]:
    """Filled by the first test that needs it."""
    return {}


@pytest.mark.parametrize("kind", sampled(["orb", "surf", "sift", "akaze"], 2))
def test_every_kind_reproduces_the_default(rdstitch: Run, tmp_path: Path, default: dict[str, Any], kind: str) -> None:
    if not default:
        default.update(stitched(rdstitch, tmp_path, "rootsift"))
    found = stitched(rdstitch, tmp_path, kind)
    assert found["options"]["features"]["kind"] == kind
    assert abs(found["lambda"] - default["lambda"]) < 0.006
    here, there = overlap(found), overlap(default)
    assert abs(np.isfinite(here).mean() - np.isfinite(there).mean()) < 0.01
    assert np.nanmedian(np.linalg.norm(here - there, axis=1)) < 1.5
