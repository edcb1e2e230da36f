"""Deep Zoom: what viewers expect, of any size, whole or not at all."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from rdstitch.io.deepzoom import read_deep_zoom
from rdstitch.io.metadata import Metadata
from rdstitch.io.strips import ImageSpec
from rdstitch.io.write import write_image, write_strips

NAMESPACE = "{http://schemas.microsoft.com/deepzoom/2008}"


def _smooth(height: int, width: int, channels: int = 3) -> NDArray[np.uint8]:
    """Colours that JPEG keeps nearly as they are, and no two places alike."""
    v, u = np.mgrid[:height, :width]
    bands = [128 + 100 * np.sin(u / 90 + k) * np.cos(v / 70 - k) for k in range(channels)]
    return np.stack(bands, axis=-1).astype(np.uint8)


def _tile(path: Path) -> NDArray[Any]:
    with Image.open(path) as image:
        return np.asarray(image)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (254, 255), (256, 256), (509, 300), (1301, 777)])
def test_levels_and_tiles_are_those_of_the_standard(tmp_path: Path, width: int, height: int) -> None:
    pixels = _smooth(height, width)
    write_image(tmp_path / "a.dzi", pixels)
    image = ElementTree.parse(tmp_path / "a.dzi").getroot()
    size = image.find(f"{NAMESPACE}Size")
    assert image.tag == f"{NAMESPACE}Image"
    assert image.attrib == {"Format": "jpg", "Overlap": "1", "TileSize": "254"}
    assert size.attrib == {"Width": str(width), "Height": str(height)}
    levels = sorted(int(folder.name) for folder in (tmp_path / "a_files").iterdir())
    largest = int(np.ceil(np.log2(max(width, height))))
    assert levels == list(range(largest + 1))
    for level in levels:
        shrink = 2 ** (largest - level)
        columns, rows = (-(-n // shrink) for n in (width, height))
        expected = {
            f"{c}_{r}.jpg": tuple(min(n, (k + 1) * 254 + 1) - max(0, k * 254 - 1) for k, n in ((r, rows), (c, columns)))
            for c in range(-(-columns // 254))
            for r in range(-(-rows // 254))
        }
        found = {tile.name: _tile(tile).shape[:2] for tile in (tmp_path / "a_files" / str(level)).iterdir()}
        assert found == expected


def test_tiles_are_the_image(tmp_path: Path) -> None:
    pixels = _smooth(777, 1301)
    write_image(tmp_path / "a.dzi", pixels, quality=98)
    for row in range(4):
        for column in range(6):
            top, left = max(0, row * 254 - 1), max(0, column * 254 - 1)
            part = pixels[top : row * 254 + 255, left : column * 254 + 255].astype(int)
            tile = _tile(tmp_path / "a_files" / "11" / f"{column}_{row}.jpg")
            assert np.abs(tile - part).max() <= 6
    half = pixels[:776, :1300].reshape(388, 2, 650, 2, 3).mean(axis=(1, 3))
    assert np.abs(read_deep_zoom(tmp_path / "a.dzi", (1301, 777), 500)[:388, :650] - half).max() <= 6


@pytest.mark.parametrize("channels", [1, 3])
def test_strips_do_not_matter(tmp_path: Path, channels: int) -> None:
    pixels = _smooth(1100, 300, channels)
    alpha = np.where(pixels[..., 0] > 60, 255, 0).astype(np.uint8)
    layout = ImageSpec((300, 1100), channels, np.dtype(np.uint8), metadata=Metadata((300, 1100)), background=200)
    for name, step in (("whole", 1280), ("strips", 256)):
        strips = [(pixels[k : k + step], alpha[k : k + step]) for k in range(0, 1100, step)]
        write_strips(tmp_path / f"{name}.dzi", layout, strips)
    tiles = sorted(path.relative_to(tmp_path / "whole_files") for path in (tmp_path / "whole_files").rglob("*.jpg"))
    assert len(tiles) > 20
    for tile in tiles:
        assert (tmp_path / "whole_files" / tile).read_bytes() == (tmp_path / "strips_files" / tile).read_bytes()
    shown = read_deep_zoom(tmp_path / "strips.dzi", (300, 1100), 1100)
    inside = (alpha == 0) & (np.roll(alpha, 8, 0) == 0) & (np.roll(alpha, -8, 0) == 0)
    assert np.abs(shown[inside].astype(int) - 200).mean() < 4
