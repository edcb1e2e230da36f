"""One registered image, as the compositor takes it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError
from rdstitch.io.read import DecodedImage

ImageLoader = Callable[[], DecodedImage]
Preview = Callable[[int], DecodedImage]

Displacement = Callable[[FloatArray], FloatArray]
"""Displacement of an image's content, pixels (..., 2), at measured pixels (..., 2): what local alignment found."""


@dataclass(frozen=True, eq=False)
class PlacedImage:
    """An image and its place."""

    # reads it (:func:`rdstitch.io.read_image`); called in other threads, before its tiles come, and perhaps again
    read: ImageLoader
    camera: Camera
    homography: FloatArray  # (3, 3): normalized undistorted coordinates to plane coordinates, or to directions
    preview: Preview | None = None  # reads it reduced by a factor, which is quicker; see :func:`rdstitch.io.read_image`
    # as the camera wrote it down (time x sensitivity / f-number²), up to a factor common to all images
    exposure: float | None = None
    # what local alignment adds to its measured pixels; see :class:`rdstitch.compositing.warp.Warp`
    displacement: Displacement | None = None
    path: str = ""  # what messages call it; its number if empty


def place_images(
    loaders: Sequence[ImageLoader],
    cameras: Sequence[Camera],
    homographies: ArrayLike,
    *,
    preview: Sequence[Preview] | None = None,
    exposure: Sequence[float | None] | None = None,
    displacement: Sequence[Displacement | None] | None = None,
    paths: Sequence[str] | None = None,
) -> list[PlacedImage]:
    """Images from lists of what is known of each; see :class:`PlacedImage`."""
    count, matrices = len(loaders), np.asarray(homographies, dtype=np.float64)
    given = (cameras, matrices, preview, exposure, displacement, paths)
    if any(values is not None and len(values) != count for values in given):
        raise ArgumentError("images, cameras, homographies and what else is given must be equally many")
    nothing = [None] * count
    more = (preview or nothing, exposure or nothing, displacement or nothing, paths or [""] * count)
    return [PlacedImage(*known) for known in zip(loaders, cameras, matrices, *more, strict=True)]
