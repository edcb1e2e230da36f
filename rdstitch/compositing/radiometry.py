"""Samples that are measurements: brightness is that of the scene, by what the camera wrote down of its exposure."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rdstitch.compositing.photometric import Exposure, no_exposure
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.results.messages import Message

_SAME = 0.005  # relative: rounding of exposure times


def are_measurements(channels: int, dtype: np.dtype[Any]) -> bool:
    """Check for what multispectral cameras write: 16 bits of one band, in proportion to light."""
    return channels == 1 and dtype == np.uint16


def exposure_by_metadata(images: Sequence[PlacedImage], channels: int) -> tuple[Exposure, Message]:
    """What makes samples proportional to light by time, sensitivity and aperture of EXIF, and what to say of it."""
    light = np.array([image.exposure or np.nan for image in images])
    if not (np.isfinite(light).all() and (light > 0.0).all()):
        text = "samples are as the camera wrote them: not every image says its exposure"
        return no_exposure(len(images), channels), Message(text, severity="note")
    middle = float(np.median(light))
    away = np.log(light / middle)
    if np.abs(away).max() < _SAME:
        text = "samples are as the camera wrote them, all of one exposure"
        return no_exposure(len(images), channels), Message(text, severity="note")
    text = (
        f"samples are those of one exposure by EXIF: time x sensitivity / f-number² of {middle:.6g} s, instead of "
        f"{light.min():.6g} to {light.max():.6g}"
    )
    return Exposure(0.0, np.repeat(away[:, None], channels, axis=1)), Message(text, severity="note")
