"""An image of what has been seen so far, painted frame by frame, of bounded size."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.radial_homography import from_plane
from rdstitch.tracking.placement import Placement

_FRAME_SIDE = 240  # longer side of a frame in the preview at first, pixels
_OUTLINE = 8  # points a side of a frame's outline


class Preview:
    """Frames painted over one another at the place that each had when it came."""

    def __init__(self, side: int = 2000) -> None:
        self._side = side
        self._pixels = np.zeros((0, 0, 3), dtype=np.uint8)
        self._painted = np.zeros((0, 0), dtype=np.uint8)
        self._origin = np.zeros(2)  # of the top-left pixel, pixels from the plane's origin
        self._scale = 0.0  # pixels per unit of the plane

    @property
    def pixels(self) -> NDArray[np.uint8]:
        """RGB (H, W, 3), black where nothing was painted."""
        return self._pixels

    @property
    def painted(self) -> NDArray[np.uint8]:
        """Mask (H, W), 255 where something was painted."""
        return self._painted

    def paint(self, image: NDArray[Any], placement: Placement) -> None:
        """Paint a frame; one that lies beyond the horizon, or far off, is left out."""
        outline = placement.to_plane(placement.camera.outline(_OUTLINE))
        if not np.isfinite(outline).all():
            return
        extent = float(np.ptp(outline, axis=0).max())
        if self._scale == 0.0:
            self._scale = _FRAME_SIDE / max(extent, 1e-12)
        if extent * self._scale > self._side:
            return
        low, high = self._make_room(outline)
        x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        plane = (np.stack([x, y], axis=-1).reshape(-1, 2) + self._origin) / self._scale
        size = np.array(image.shape[1::-1])
        place = (from_plane(placement.camera, placement.homography, plane) + 0.5) * (
            size / np.array(placement.camera.image_size)
        ) - 0.5
        inside = np.isfinite(place).all(axis=1) & (place >= 0.0).all(axis=1) & (place <= size - 1.0).all(axis=1)
        mapped = np.where(inside[:, None], place, -1.0).astype(np.float32).reshape(*x.shape, 2)
        colours = cv2.remap(_as_rgb(image), mapped[..., 0], mapped[..., 1], cv2.INTER_LINEAR)
        box = (slice(low[1], high[1]), slice(low[0], high[0]))
        shown = inside.reshape(x.shape)
        self._pixels[box][shown] = colours[shown]
        self._painted[box][shown] = 255

    def _make_room(self, outline: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Enlarge the image so that an outline (K, 2) of the plane lies in it; its box in pixels."""
        while True:
            low = np.floor(outline.min(axis=0) * self._scale).astype(np.intp)
            high = np.ceil(outline.max(axis=0) * self._scale).astype(np.intp) + 1
            size = np.array(self._painted.shape[::-1], dtype=np.intp)
            origin = self._origin.astype(np.intp)
            start = np.minimum(low, origin) if size.all() else low
            end = np.maximum(high, origin + size) if size.all() else high
            if (end - start).max() <= self._side:
                break
            self._halve()
        shift, wanted = origin - start, end - start
        if shift.any() or (wanted != size).any():
            self._pixels = _moved(self._pixels, shift, wanted)
            self._painted = _moved(self._painted, shift, wanted)
            self._origin = start.astype(np.float64)
        return low - start, high - start

    def _halve(self) -> None:
        """Half as many pixels a side; an odd row or column at the border is lost."""
        odd = self._origin.astype(np.intp) % 2
        self._pixels, self._painted = self._pixels[odd[1] :: 2, odd[0] :: 2], self._painted[odd[1] :: 2, odd[0] :: 2]
        self._origin = (self._origin + odd) / 2.0
        self._scale /= 2.0


def _moved(pixels: NDArray[np.uint8], shift: NDArray[np.intp], size: NDArray[np.intp]) -> NDArray[np.uint8]:
    """A larger image (of width and height ``size``) with the old one at some place of it."""
    larger = np.zeros((size[1], size[0], *pixels.shape[2:]), dtype=np.uint8)
    height, width = pixels.shape[:2]
    if width and height:
        larger[shift[1] : shift[1] + height, shift[0] : shift[0] + width] = pixels
    return larger


def _as_rgb(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Eight bits and three channels of any image."""
    scaled = image
    if image.dtype != np.uint8:
        full = 65535.0 if image.dtype == np.uint16 else 1.0
        scaled = np.clip(image * (255.0 / full), 0.0, 255.0).astype(np.uint8)
    if scaled.ndim == 2:
        scaled = scaled[:, :, None]
    if scaled.shape[2] < 3:
        scaled = np.repeat(scaled[:, :, :1], 3, axis=2)
    return np.ascontiguousarray(scaled[:, :, :3], dtype=np.uint8)
