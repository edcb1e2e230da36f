"""An image of what has been seen so far, painted frame by frame, of bounded size, and written now and then."""

import math
from pathlib import Path
from time import monotonic
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import RdstitchError
from rdstitch.geometry.radial_homography import from_plane
from rdstitch.inputs.source import Source
from rdstitch.io.write import write_image
from rdstitch.results.messages import Message
from rdstitch.tracking.placement import Placement
from rdstitch.tracking.tracked_frame import TrackingResult

_FRAME_SIDE = 240  # longer side of a frame in the preview at first, pixels
_OUTLINE = 8  # points a side of a frame's outline
_MEGAPIXELS = 0.08  # 10⁶ pixels that a keyframe is read with
_FARTHEST = 4  # times the longest side: what would make the preview longer, before it is halved, is wrongly placed


class Preview:
    """Frames painted over one another at the place that each had when it came.

    What is painted, RGB (H, W, 3), black where nothing is, is halved whenever a side would become longer than ``side``.
    """

    def __init__(self, side: int = 2000) -> None:
        self._side = side
        self.pixels = np.zeros((0, 0, 3), dtype=np.uint8)
        self._origin = np.zeros(2, dtype=np.intp)  # of the top-left pixel, pixels from the plane's origin
        self._scale = 1.0  # pixels per unit of the plane, by the first frame that is painted

    def paint(self, image: NDArray[Any], placement: Placement) -> None:
        """Paint a frame (H, W) or (H, W, C) of any size; one beyond the horizon, too large or far away is left out."""
        outline = placement.to_plane(placement.camera.outline(_OUTLINE))
        if not np.isfinite(outline).all():
            return
        extent = float(np.ptp(outline, axis=0).max())
        if not self.pixels.size:
            self._scale = _FRAME_SIDE / max(extent, 1e-12)
        painted = (self._origin + np.array([[0, 0], self.pixels.shape[1::-1]])) / self._scale
        reach = float(np.ptp(np.vstack([outline, painted]), axis=0).max()) if self.pixels.size else extent
        if extent * self._scale > self._side or reach * self._scale > _FARTHEST * self._side:
            return
        low, high = self._make_room(outline)
        x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        plane = np.stack([x, y], axis=-1).reshape(-1, 2) / self._scale
        size = np.array(image.shape[1::-1])
        place = (from_plane(placement.camera, placement.homography, plane) + 0.5) * (
            size / np.array(placement.camera.image_size)
        ) - 0.5
        inside = np.isfinite(place).all(axis=1) & (place >= 0.0).all(axis=1) & (place <= size - 1.0).all(axis=1)
        mapped = np.where(inside[:, None], place, -1.0).astype(np.float32).reshape(*x.shape, 2)
        colours = cv2.remap(_as_rgb(image), mapped[..., 0], mapped[..., 1], cv2.INTER_LINEAR)
        shown = inside.reshape(x.shape)
        self._part(low, high)[shown] = colours[shown]

    def _part(self, low: NDArray[np.intp], high: NDArray[np.intp]) -> NDArray[np.uint8]:
        """Painted pixels between two corners, pixels from the plane's origin; a view."""
        (left, top), (right, bottom) = low - self._origin, high - self._origin
        return self.pixels[top:bottom, left:right]

    def _make_room(self, outline: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Enlarge the image so that an outline (K, 2) of the plane lies in it; its box, pixels from the origin."""
        while True:
            low = np.floor(outline.min(axis=0) * self._scale).astype(np.intp)
            high = np.ceil(outline.max(axis=0) * self._scale).astype(np.intp) + 1
            before, size = self._origin, np.array(self.pixels.shape[1::-1], dtype=np.intp)
            start, end = (np.minimum(low, before), np.maximum(high, before + size)) if size.all() else (low, high)
            if (end - start).max() <= self._side:
                break
            # Half as many pixels a side; an odd row or column at the border is lost.
            odd = before % 2
            self.pixels, self._origin = self.pixels[odd[1] :: 2, odd[0] :: 2], (before + odd) // 2
            self._scale /= 2.0
        painted = self.pixels
        self.pixels, self._origin = np.zeros((*(end - start)[::-1], 3), dtype=np.uint8), start
        if size.all():
            self._part(before, before + size)[...] = painted
        return low, high


class LivePreview:
    """The preview and its file."""

    def __init__(self, file: Path, refresh: float) -> None:
        self._file, self._refresh, self._mosaic = file, refresh, Preview()
        self._written, self._changed, self._failed = -math.inf, False, False

    def add(self, source: Source, result: TrackingResult) -> list[Message]:
        """Paint a keyframe; write the file when that is due. What fails is told once: the frames are worth more."""
        if self._failed:
            return []
        try:
            if result.keyframe and result.placement is not None:
                image = source.read(source.reduction(_MEGAPIXELS))
                self._mosaic.paint(image.pixels, result.placement)
                self._changed = True
            if monotonic() - self._written >= self._refresh:
                self.write()
        except RdstitchError as error:
            self._failed = True
            return [Message(f"no preview any more: {error}")]
        return []

    def write(self) -> None:
        """Replace the file, if there is anything new."""
        if self._changed and self._mosaic.pixels.size:
            write_image(self._file, self._mosaic.pixels, overwrite=True)
            self._written, self._changed = monotonic(), False


def _as_rgb(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Eight bits and three channels of any image."""
    full = {"uint8": 255.0, "uint16": 65535.0}.get(image.dtype.name, 1.0)
    eight = image if full == 255.0 else np.clip(image * (255.0 / full), 0.0, 255.0)
    channels = eight.reshape(*eight.shape[:2], -1)
    return np.ascontiguousarray(channels[:, :, [0, 0, 0] if channels.shape[2] < 3 else [0, 1, 2]], dtype=np.uint8)
