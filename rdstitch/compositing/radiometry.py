"""Samples that are measurements: brightness is that of the scene, by what cameras wrote of exposure and light."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rdstitch.compositing.photometric import Exposure, no_exposure
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.results.messages import Message

_SAME = 0.005  # relative: rounding of exposure times


def are_measurements(images: Sequence[PlacedImage], channels: int, dtype: np.dtype[Any]) -> bool:
    """Check for bands of 16 bits of multispectral and thermal cameras, in proportion to light; not for scans."""
    return channels == 1 and dtype == np.uint16 and all(image.radiometry is not None for image in images)


def exposure_by_metadata(images: Sequence[PlacedImage], channels: int) -> tuple[Exposure, Message]:
    """What makes samples proportional to reflectance by what images say of exposure and light, and a line on it."""
    exposure = np.array([image.exposure or np.nan for image in images])
    known = [image.radiometry for image in images if image.radiometry is not None]
    irradiance = np.array([each.irradiance or np.nan for each in known])
    parts = [(exposure, "exposure by EXIF (time x sensitivity / f-number²)")]
    if len(known) == len(images) and np.isfinite(irradiance).all():
        parts.append((irradiance, f"irradiance by XMP ({', '.join(sorted({each.source for each in known}))})"))
    light = np.prod([values for values, _ in parts], axis=0)
    if not (np.isfinite(light).all() and (light > 0.0).all()):
        text = "samples are as the camera wrote them: not every image says its exposure"
        return no_exposure(len(images), channels), Message(text, severity="note")
    away = np.log(light / np.median(light))
    if np.abs(away).max() < _SAME:
        text = "samples are as the camera wrote them, all of one exposure"
        return no_exposure(len(images), channels), Message(text, severity="note")
    ranges = " and ".join(
        f"{what}, which differs by a factor of {values.max() / values.min():.3g}" for values, what in parts
    )
    black = float(np.mean([each.black for each in known])) if known else 0.0
    level = f", above a black level of {black:.2%} of the full range" if black else ""
    text = f"samples are those of one {ranges}{level}"
    return Exposure(-black, np.repeat(away[:, None], channels, axis=1)), Message(text, severity="note")
