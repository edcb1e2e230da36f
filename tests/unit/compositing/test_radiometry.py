"""Samples of multispectral cameras stay measurements."""

import base64
import struct
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from rdstitch.compositing import CompositeOptions, compose
from rdstitch.compositing.canvas import plan_canvas
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.geometry.camera import Camera
from rdstitch.io.metadata import Metadata
from rdstitch.io.radiometric_tags import Radiometry, read_radiometry
from rdstitch.io.read import DecodedImage, reduced


def _field(times: tuple[float, ...], index: float = 2.0) -> tuple[list[PlacedImage], np.ndarray]:
    """Images side by side of a field whose reflectance grows to the right, and what one exposure of 0.01 s gives."""
    camera = Camera((200, 120), distortion=0.0)
    scene = index * np.broadcast_to(np.linspace(4000.0, 12000.0, 400), (120, 400))
    images = []
    for k, time in enumerate(times):
        samples = np.rint(scene[:, 100 * k : 100 * k + 200] * time / 0.01).astype(np.uint16)
        part = DecodedImage(samples, None, Metadata((200, 120)))
        shift = np.array([[camera.scale, 0.0, 100.0 * k], [0.0, camera.scale, 0.0], [0.0, 0.0, 1.0]])
        images.append(PlacedImage(partial(reduced, part), camera, shift, exposure=time, radiometry=Radiometry()))
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
    # Scans are balanced.
    assert not compose([replace(image, radiometry=None) for image in images], canvas, options).messages


def test_light_that_changes_and_a_black_level_leave_an_index_as_it_is() -> None:
    """Clouds: the same field under half the light; darkness has 4800 of 65535."""
    light, times = (1.0, 0.5, 0.8), (0.008, 0.014, 0.0125)
    options = CompositeOptions(interpolation="linear", seam="none", blend="feather")
    composed = []
    for index in (1.0, 2.0):  # bands whose ratio is 2 everywhere
        images, scene = _field(tuple(np.multiply(light, times)), index)
        for k, image in enumerate(images):
            decoded = image.read(1)
            dark = replace(decoded, pixels=decoded.pixels + np.uint16(4800))
            told = Radiometry(4800 / 65535, light[k] * 0.7, "HorizontalIrradiance")
            images[k] = replace(image, read=partial(reduced, dark), exposure=times[k], radiometry=told)
        canvas = plan_canvas([image.camera for image in images], [image.homography for image in images])
        result = compose(images, canvas, options)
        assert "irradiance by XMP (HorizontalIrradiance)" in result.messages[0].text
        composed.append(result.pixels[10:110, 5:395].astype(np.float64).reshape(100, 390) - 4800)
        ratio = composed[-1] / scene[10:110, 5:395]
        assert ratio.max() / ratio.min() < 1.01
    ratio = composed[1] / composed[0]
    assert ratio.max() / ratio.min() < 1.01


@pytest.mark.parametrize(
    ("xmp", "black", "expected"),
    [
        ("", None, None),
        ("<x Camera:BandName='Red'>", None, Radiometry()),
        ("<x a:HorizontalIrradiance='0.61' a:Irradiance='0.5'>", (4800, 4800), (0.61, "HorizontalIrradiance")),
        ("<Camera:Irradiance><rdf:Seq> <rdf:li>0.5</rdf:li></rdf:Seq></Camera:Irradiance>", 4800, (0.5, "Irradiance")),
        ("<x Camera:IrradianceList='@'>", 4800, (8.48, "IrradianceList")),
        ("<x Camera:IrradianceList='&#xA;no base64 !'>", 4800, (None, "")),
        ("<x Camera:Irradiance='nan'>", 4800, (None, "")),
    ],
)
def test_tags_of_multispectral_cameras(xmp: str, black: object, expected: Any) -> None:
    records = [struct.pack("<QHHHHfff", k, 848 + k, 200, 1 if k else 0, 4 if k else 100, 0, 0, 0) for k in range(3)]
    text = base64.b64encode(b"".join(records)).decode()
    found = read_radiometry(xmp.replace("@", f"&#xA;{text[:30]}&#xA;{text[30:]}&#xA;"), black, 16)
    if isinstance(expected, tuple):
        expected = Radiometry(4800 / 65535, *expected)
        assert found.irradiance is None or found.irradiance == pytest.approx(expected.irradiance, rel=0.01)
        found = replace(found, irradiance=expected.irradiance)
    assert found == expected
