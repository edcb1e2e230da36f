"""One registered image, as the compositor takes it."""

from collections.abc import Callable
from dataclasses import dataclass

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
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
