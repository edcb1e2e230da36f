"""``--layers``: each image on its own; put together by their masks they are the composite."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image

from rdstitch.io.read import read_image
from rdstitch.io.tiff import write_cropped_tiff
from tests.cli.running import CACHED, Run


@pytest.mark.parametrize("whole", [False, True])
def test_layers_by_their_masks_are_the_composite(
    rdstitch: Run, frames: list[Path], tmp_path: Path, whole: bool
) -> None:
    output, folder = tmp_path / "all.png", tmp_path / "layers"
    more = ["--whole-layers"] if whole else []
    rdstitch("mosaic", frames[0].parent, "-o", output, "--blend", "none", "--layers", folder, *more, *CACHED, err="")
    composite = read_image(output)
    joined = np.zeros_like(composite.pixels)
    owners: NDArray[np.int_] = np.zeros(composite.alpha.shape, dtype=np.int_)
    for frame in frames:
        with tifffile.TiffFile(folder / f"{frame.stem}.tif") as file:
            page = file.pages.first
            layer = page.asarray()
            mask = tifffile.imread(folder / f"{frame.stem}_mask.tif")
            x, y = (round(150 * page.tags[tag].value[0] / page.tags[tag].value[1]) for tag in (286, 287))
            assert (page.tags[33300].value, page.tags[33301].value) == owners.shape[::-1]
        height, width = mask.shape
        assert layer.shape == (height, width, composite.pixels.shape[2] + 1 if composite.pixels.ndim == 3 else 2)
        assert ((height, width) == owners.shape) == whole
        assert (layer[..., -1][mask > 0] == 255).all()
        there = np.s_[y : y + height, x : x + width]
        pixels = layer[..., :-1] if composite.pixels.ndim == 3 else layer[..., 0]
        joined[there][mask > 0] = pixels[mask > 0]
        owners[there] += mask > 0
        with Image.open(folder / f"{frame.stem}.tif") as image:
            assert image.size == (width, height)
    np.testing.assert_array_equal(owners, composite.alpha > 0)
    # Seams are found once more, on the same small versions of the images.
    shown = np.where(owners[..., None] > 0, np.atleast_3d(composite.pixels), 0)
    np.testing.assert_array_equal(np.atleast_3d(joined), shown)


def test_what_is_there_is_kept(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "layers"
    folder.mkdir()
    (folder / f"{frames[0].stem}.tif").write_bytes(b"mine")
    rdstitch("mosaic", frames[0].parent, "-o", tmp_path / "a.png", "--layers", folder, *CACHED, told="exists")
    assert [file.read_bytes() for file in folder.iterdir()] == [b"mine"]
