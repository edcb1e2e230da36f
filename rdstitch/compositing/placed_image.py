"""One registered image, as the compositor takes it."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError
from rdstitch.frozen import dataclass
from rdstitch.io.read import DecodedImage

ImageLoader = Callable[[], DecodedImage]
Preview = Callable[[int], DecodedImage]

Displacement = Callable[[FloatArray], FloatArray]
"""Displacement of an image's content, pixels (..., 2), at measured pixels (..., 2): what local alignment found."""


@dataclass(frozen=True, eq=False)
class PlacedImage:
    """An image and its place.

    Attributes
    ----------
    read : callable
        Reads it (:func:`rdstitch.io.read_image`); called in other threads, before its tiles come, and perhaps again.
    camera : Camera
    homography : ndarray of shape (3, 3)
        Normalized undistorted coordinates to plane coordinates, or to directions.
    preview : callable, optional
        Reads it reduced by a factor, which is quicker; see :func:`rdstitch.io.read_image`.
    exposure : float, optional
        As the camera wrote it down (time x sensitivity / f-number²), up to a factor common to all images.
    displacement : callable, optional
        What local alignment adds to its measured pixels; see :class:`rdstitch.compositing.warp.Warp`.
    path : str
        What messages call it; its number if empty.
    """

    read: ImageLoader
    camera: Camera
    homography: FloatArray
    preview: Preview | None = None
    exposure: float | None = None
    displacement: Displacement | None = None
    path: str = ""


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
    """Images from lists of what is known of each; see :class:`PlacedImage`.

    Raises
    ------
    ArgumentError
        When the lists are not of one length.
    """
    count, matrices = len(loaders), np.asarray(homographies, dtype=np.float64)
    given = (cameras, matrices, preview, exposure, displacement, paths)
    if any(values is not None and len(values) != count for values in given):
        raise ArgumentError("images, cameras, homographies and what else is given must be equally many")
    nothing = [None] * count
    more = (preview or nothing, exposure or nothing, displacement or nothing, paths or [""] * count)
    return [PlacedImage(*known) for known in zip(loaders, cameras, matrices, *more, strict=True)]
