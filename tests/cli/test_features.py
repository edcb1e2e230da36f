"""``--features``: every kind gives what the default gives."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.cli.running import Run, sidecar_of
from tests.sampled import sampled

PAIR = sorted((Path(__file__).resolve().parents[2] / "examples/data/garfield_red").glob("*.jpg"))
# What is looked at is the registration; the image may be small.
SMALL = ("--scale", "0.1", "--blend", "feather", "--seam", "voronoi", "-j", "1")


def stitched(rdstitch: Run, folder: Path, kind: str) -> dict[str, Any]:
    output = folder / f"{kind}.jpg"
    done = rdstitch("pano", *PAIR, "-o", output, "--features", kind, "--reference", PAIR[0].name, *SMALL)
    assert all("[few-images]" in line for line in done.err.splitlines())
    record: dict[str, Any] = sidecar_of(output)
    return record


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
    here, there = (np.array(record["images"][1]["to_plane"]) for record in (found, default))
    np.testing.assert_allclose(here / here[2, 2], there / there[2, 2], atol=0.01)
