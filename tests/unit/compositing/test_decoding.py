"""Every image is decoded once for exposure and seams, and once for the tiles, whatever memory there is."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from rdstitch.compositing import CompositeOptions, PlacedImage, compose
from rdstitch.compositing.image_cache import ImageCache
from rdstitch.compositing.source_images import ImageReader
from rdstitch.io import DecodedImage
from rdstitch.io.read import reduced
from tests.compositing_scenes import Scene, as_image, render


def _counted(scene: Scene, decoded: Counter[int], *, masked: bool) -> list[PlacedImage]:
    """The images of a scene; of masked ones a disc and a strip are transparent."""
    images = []
    for index, (frame, placed) in enumerate(zip(scene.frames, scene.images, strict=True)):
        alpha = np.full(frame.shape[:2], 255, dtype=np.uint8)
        cv2.circle(alpha, (80, 60 + 7 * index), 30, 0, -1)
        alpha[:20] = 0
        image = as_image(frame, alpha if masked and index % 3 else None)

        def read(index: int = index, image: DecodedImage = image) -> DecodedImage:
            decoded[index] += 1
            return image

        def preview(reduction: int, image: DecodedImage = image) -> DecodedImage:
            return reduced(image, reduction)

        images.append(replace(placed, read=read, preview=preview))
    return images


@pytest.mark.parametrize(
    ("options", "masked"),
    [
        ({}, True),
        ({"seam": "voronoi", "blend": "feather"}, False),
        ({"seam": "none"}, True),
        ({"seam": "none", "blend": "none", "exposure": "none"}, False),
        ({"scale": 0.4, "workers": 2}, True),
    ],
    ids=str,
)
def test_whatever_the_memory(options: dict[str, Any], masked: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = render(3, 2, size=(240, 180), rotate=37.0, scale=options.get("scale", 1.2))
    chosen = CompositeOptions(tile_size=256, bands=4, **({"workers": 1} | options | {"scale": 1.0}))
    # Exposure and seams are decided on small images, which are not read smaller from images as small as these.
    most = 1 if options.get("exposure") == "none" else 2
    decoded: Counter[int] = Counter()
    plenty = compose(_counted(scene, decoded, masked=masked), scene.canvas, chosen)
    assert max(decoded.values()) <= most
    decoded.clear()

    # The least that the plan allows: room for one image.
    def tight(reader: ImageReader, shrinks: Sequence[float], limit: int, *, ahead: bool) -> ImageCache:
        return ImageCache(reader, shrinks, 1, ahead=ahead)

    monkeypatch.setattr("rdstitch.compositing.preparation.ImageCache", tight)
    little = compose(_counted(scene, decoded, masked=masked), scene.canvas, chosen)
    assert max(decoded.values()) <= most
    np.testing.assert_array_equal(little.pixels, plenty.pixels)
    np.testing.assert_array_equal(little.alpha, plenty.alpha)
