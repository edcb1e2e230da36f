"""Images that fail a check are left out by name, and the rest is stitched."""

from pathlib import Path

import numpy as np
import pytest

from rdstitch.io import read_image, write_image
from tests.cli.running import CACHED, DISTORTION, Run, flight


@pytest.fixture
def spoiled(tmp_path: Path) -> list[Path]:
    """Five images in a row; the last shows other ground, but for a patch by which it is registered."""
    frames = flight(3, 5).write(tmp_path, "frame_{}.png")
    true = read_image(frames[4]).pixels
    image = flight(29, 5).frame(4).copy()
    height, width = image.shape[:2]
    patch = np.s_[height // 3 : height // 3 + 80, width // 8 : width // 8 + 80]
    image[patch] = true[patch]
    write_image(frames[4], image)
    return frames


@pytest.mark.parametrize("strict", [False, True])
def test_an_image_that_fails_its_checks_is_left_out_by_name(
    rdstitch: Run, spoiled: list[Path], tmp_path: Path, strict: bool
) -> None:
    extra = ("--strict",) if strict else ()
    done = rdstitch("mosaic", *spoiled, "-o", tmp_path / "out.png", *CACHED, *extra, status=5 if strict else 0)
    assert f"left out {spoiled[4]}" in done.err
    assert not any(f"left out {path}" in done.err for path in spoiled[:4])
    assert strict or abs(float(done.out) - DISTORTION) < 0.005


def test_images_of_another_block_are_named_in_one_line(rdstitch: Run, tmp_path: Path) -> None:
    own, others = flight(3, 3).write(tmp_path, "a{}.png"), flight(29, 2).write(tmp_path, "b{}.png")
    done = rdstitch("mosaic", *own, *others, "-o", tmp_path / "out.png", *CACHED)
    (line,) = [line for line in done.err.splitlines() if "left out" in line]
    assert f"left out {others[0]}, {others[1].name}: in block 2 of 2, whose 2 images overlap with none" in line
