"""``--mask``: what it excludes is neither matched nor shown."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from examples.worlds.adverse_sets import adverse_set
from rdstitch.io.read import read_image
from tests.cli.running import CACHED, DISTORTION, Run, copied, sidecar_of

LEG = (255, 0, 255)


@pytest.fixture
def legs(frames: list[Path], tmp_path: Path) -> Path:
    """The images, each with the same textured leg in it, which moves with the camera; the mask beside them."""
    folder = tmp_path / "legs"
    folder.mkdir()
    mask = np.full((300, 400), 255, np.uint8)
    cv2.fillPoly(mask, [np.array([[0, 170], [150, 190], [170, 215], [0, 230]])], 0)
    leg = np.zeros((300, 400, 3), np.uint8)
    leg[:] = LEG
    leg[np.random.default_rng(0).random((300, 400)) < 0.2] = 0
    for path in frames:
        image = cv2.imread(str(path))
        image[mask == 0] = leg[mask == 0]
        assert cv2.imwrite(str(folder / path.name), image)
    assert cv2.imwrite(str(tmp_path / "mask.png"), mask)
    return folder


def leg_pixels(output: Path) -> int:
    """Number of px that have the leg's colour."""
    image = read_image(output)
    away = np.abs(image.pixels.astype(int) - LEG).max(axis=2)
    return int(((away < 60) & (image.alpha > 0)).sum())


@pytest.mark.parametrize("command", ["mosaic", "pano"])
@pytest.mark.parametrize("one", [True, False])
def test_a_leg_is_not_matched_nor_shown(rdstitch: Run, legs: Path, tmp_path: Path, command: str, *, one: bool) -> None:
    mask = tmp_path / "mask.png"
    if not one:
        names = [path.name for path in legs.iterdir()]
        mask = copied([mask] * len(names), tmp_path / "masks", *names)[0].parent
    output = tmp_path / "out.png"
    done = rdstitch(command, *sorted(legs.iterdir()), "-o", output, "--mask", mask, *CACHED, err="")
    assert abs(float(done.out) - DISTORTION) < 0.01
    assert leg_pixels(output) == 0
    assert sidecar_of(output)["options"]["mask"] == str(mask)


def test_without_a_mask_the_leg_is_seen_and_apply_takes_masks_too(rdstitch: Run, legs: Path, tmp_path: Path) -> None:
    output, again = tmp_path / "out.png", tmp_path / "again.png"
    rdstitch("mosaic", legs, "-o", output, "--mask", tmp_path / "mask.png", *CACHED)
    arguments = ("apply", f"{output}.json", "--images", legs, "-o", again, "--overwrite", "-j", "1")
    rdstitch(*arguments)
    assert leg_pixels(again) > 1000
    rdstitch(*arguments, "--mask", tmp_path / "mask.png")
    np.testing.assert_array_equal(read_image(again).pixels, read_image(output).pixels)


def test_images_without_a_mask_are_reported(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    assert cv2.imwrite(str(tmp_path / "masks" / f"{frames[0].stem}.bmp"), np.full((30, 40), 255, np.uint8))
    done = rdstitch("pano", *frames, "-o", tmp_path / "out.png", "--mask", tmp_path / "masks", *CACHED)
    assert done.line.endswith(f"2 of 3 images have no mask: {frames[1].name}, {frames[2].name}")


def test_a_black_border_in_all_images_is_masked(rdstitch: Run, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    adverse_set("round border", 2).write(images)
    done = rdstitch("mosaic", images, "-o", tmp_path / "out.png", "-v", *CACHED)
    assert "of every image is black, or stays where it is" in done.err
    found = read_image(tmp_path / "out.png")
    light = found.pixels.max(axis=2)
    assert (light[found.alpha > 0] < 8).mean() < 0.02
    again = ("apply", tmp_path / "out.png.json", "--images", images, "-o", tmp_path / "again.png")
    rdstitch(*again)
    assert (tmp_path / "again.png").read_bytes() == (tmp_path / "out.png").read_bytes()
