"""Samples of multispectral cameras stay measurements."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from rdstitch.compositing import CompositeOptions, compose
from rdstitch.compositing.canvas import plan_canvas
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.geometry.camera import Camera
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage


def _given(image: DecodedImage) -> DecodedImage:
    return image


def _field(times: tuple[float, ...], index: float = 2.0) -> tuple[list[PlacedImage], np.ndarray]:
    """Images side by side of a field whose reflectance grows to the right, and what one exposure of 0.01 s gives."""
    camera = Camera((200, 120), distortion=0.0)
    scene = index * np.broadcast_to(np.linspace(4000.0, 12000.0, 400), (120, 400))
    images = []
    for k, time in enumerate(times):
        samples = np.rint(scene[:, 100 * k : 100 * k + 200] * time / 0.01).astype(np.uint16)
        part = DecodedImage(samples, None, Metadata((200, 120)))
        shift = np.array([[camera.scale, 0.0, 100.0 * k], [0.0, camera.scale, 0.0], [0.0, 0.0, 1.0]])
        images.append(PlacedImage(partial(_given, part), camera, shift, exposure=time))
    return images, scene


@pytest.mark.parametrize("times", [(0.01, 0.01, 0.01), (0.008, 0.01, 0.0125)])
def test_ratios_of_bands_are_those_of_the_scene(times: tuple[float, ...]) -> None:
    images, scene = _field(times)
    canvas = plan_canvas([image.camera for image in images], [image.homography for image in images])
    options = CompositeOptions(interpolation="linear", seam="none", blend="feather")
    result = compose(images, canvas, options)
    inside = result.pixels[10:110, 5:395].astype(np.float64).reshape(100, 390)
    assert np.abs(inside / scene[10:110, 5:395] - 1.0).max() < 0.01
    (said,) = result.messages
    assert ("one exposure by EXIF" in said.text) == (len(set(times)) > 1)
    unsaid = [replace(image, exposure=None) for image in images]
    assert "not every image says" in compose(unsaid, canvas, options).messages[0].text
