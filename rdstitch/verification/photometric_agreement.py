"""Do two images show the same where they overlap? Asked of the pixels, not of the features that registered them.

One image is resampled as the other's lens would have seen it. In each small cell of the overlap that has texture,
the place where the two correlate best is searched around where the registration says it is. Where the registration is
right nearly all cells find it there; elsewhere they find it anywhere.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.lattice import Lattice
from rdstitch.compositing.likeness import likeness
from rdstitch.compositing.seam_quality import SeamTile
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import from_plane, to_plane
from rdstitch.io.read import DecodedImage
from rdstitch.io.reduction import mean_of_channels
from rdstitch.verification.limits import Limits

# Boxes, interpolated places and the likeness of two greys are shared with the compositor: none of them knows where a
# registration puts images, so that what judges it is still not what made it.

Grey = NDArray[np.float32]

COMPARED_SIDE = 512  # pixels of the longer side of the images that are compared
_RESIZED_CHANNELS = 4  # at most, that OpenCV makes smaller by a share
CELL = 24  # pixels
_SEARCH_RADIUS = 8  # pixels
_OPAQUE = 250
_PLAIN = 0.1  # of the median deviation of the rows of an image: a row of less is plain
_LATTICE = 8  # pixels between the places that are computed; those between are interpolated


@dataclass(frozen=True)
class Agreement:
    """What the cells of an overlap say."""

    cells: int  # cells with texture in both images
    confirming: int  # cells that correlate best, and well, where the registration says
    textured_cells: int = 0  # cells with texture in the whole of the second image
    # fraction of the overlap that looks alike three times smaller; NaN where it is too small
    coarse_similarity: float = math.nan

    @property
    def confirming_fraction(self) -> float | None:
        """Fraction of the cells that confirm the registration; None where they are too few to say anything."""
        return self.confirming / self.cells if self.cells >= Limits.min_cells else None

    @property
    def unlike_cells(self) -> float:
        """Number of the cells that look different three times smaller, where depth and blur are no difference."""
        return 0.0 if math.isnan(self.coarse_similarity) else self.cells * (1.0 - self.coarse_similarity)


@dataclass(frozen=True, eq=False)
class ComparedImage:
    """A registered image as it is compared."""

    grey: Grey  # (h, w), float32: in [0, 1], small; NaN where transparent
    camera: Camera  # of the size of ``grey``
    homography: FloatArray  # (3, 3): from undistorted normalized coordinates to the plane

    @classmethod
    def of(
        cls, image: DecodedImage, camera: Camera, homography: FloatArray, stretch: tuple[float, float] | None = None
    ) -> Self:
        """Make an image with its camera and its place small; ``stretch`` are the grey levels of black and white."""
        grey = _reduced_grey(image, stretch)
        grey[_plain_frame(grey)] = np.nan
        return cls(grey, camera.resized((grey.shape[1], grey.shape[0])), homography)

    def sampled(self, plane: Callable[[FloatArray], FloatArray], box: Box) -> Grey:
        """The image where ``plane``, (M, 2) to (M, 2), puts pixels of the plane; NaN outside the image."""

        def places(x: FloatArray, y: FloatArray) -> FloatArray:
            grid = np.stack(np.broadcast_arrays(x, y), axis=-1)
            return from_plane(self.camera, self.homography, plane(grid.reshape(-1, 2))).reshape(grid.shape)

        x, y = Lattice.over(box, _LATTICE, places).maps(box)
        sampled = cv2.remap(
            self.grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(float("nan"),)
        )
        return np.asarray(sampled, dtype=np.float32)


def _reduced_grey(image: DecodedImage, stretch: tuple[float, float] | None) -> Grey:
    pixels = image.pixels
    largest = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else np.nanmax(pixels, initial=1e-12)
    black, full = 0.0, float(largest)
    if stretch is not None:
        # Correlations of small differences on a large base would be lost in rounding.
        black, full = stretch[0], max(stretch[1] - stretch[0], 1e-12)
    height, width = pixels.shape[:2]
    factor = min(1.0, COMPARED_SIDE / max(width, height))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    if pixels.ndim == 3 and pixels.shape[2] > _RESIZED_CHANNELS:
        pixels = mean_of_channels(pixels.astype(np.float32))
    small = (cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.float32) - black) / np.float32(full)
    grey = mean_of_channels(small)
    if image.alpha is not None:
        grey[cv2.resize(image.alpha, size, interpolation=cv2.INTER_AREA) < _OPAQUE] = np.nan
    return grey


def _plain_frame(grey: Grey) -> NDArray[np.bool_]:
    """Mark rows and columns from the border on that show nothing: frames of two images coincide wherever these lie."""
    frame = np.zeros_like(grey, dtype=np.bool_)
    for image, masked in ((grey, frame), (grey.T, frame.T)):
        inside = ~masked.all(axis=0)
        rows = image[:, inside].astype(np.float64)
        known = np.isfinite(rows)
        count = np.maximum(known.sum(axis=1), 1)
        centred = np.where(known, rows - np.where(known, rows, 0.0).sum(axis=1, keepdims=True) / count[:, None], 0.0)
        texture = np.sqrt((centred**2).sum(axis=1) / count)
        shown = np.flatnonzero(texture > _PLAIN * np.median(texture))
        if len(shown) and len(shown) < len(image):
            first, last = shown[[0, -1]]
            # The next row is mixed with the frame where the image was made smaller.
            if first > 0:
                masked[: first + 1] = True
            if last < len(image) - 1:
                masked[last:] = True
    return frame


def overlap_agreement(first: ComparedImage, second: ComparedImage) -> Agreement:
    """Compare two registered images where they overlap."""
    height, width = second.grey.shape
    # The first image as the second one's lens would have seen it.
    seen = first.sampled(partial(to_plane, second.camera, second.homography), (0, 0, width, height))
    margin = CELL // 2 + _SEARCH_RADIUS
    rows, columns = (np.arange(margin, n - margin + 1, CELL) for n in (height, width))
    corners = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2) - CELL // 2
    cells, windows = _cells(seen, corners), _cells(second.grey, corners, _SEARCH_RADIUS)
    textured = _have_texture(windows[:, _SEARCH_RADIUS:-_SEARCH_RADIUS, _SEARCH_RADIUS:-_SEARCH_RADIUS])
    known = textured & _have_texture(cells) & np.isfinite(windows).all(axis=(1, 2))
    confirming = sum(_confirms(*both) for both in zip(cells[known], windows[known], strict=True))
    tiles = [SeamTile((0, 0, width, height), np.nan_to_num(grey), np.isfinite(grey)) for grey in (seen, second.grey)]
    return Agreement(int(known.sum()), confirming, int(textured.sum()), likeness(tiles, np.array([[0, 1]]), 1.0).alike)


def _cells(image: Grey, corners: NDArray[np.intp], margin: int = 0) -> Grey:
    """Cells (N, side, side) with these top-left pixels (N, 2), row and column, and so much around them."""
    side = CELL + 2 * margin
    if not len(corners):
        return np.zeros((0, side, side), dtype=np.float32)
    top, left = (corners - margin).T
    return np.asarray(np.lib.stride_tricks.sliding_window_view(image, (side, side))[top, left])


def _have_texture(cells: Grey) -> NDArray[np.bool_]:
    """Which cells (N, h, w) are distinctive; not those with transparent pixels, whose deviation is NaN."""
    return np.asarray(cells.std(axis=(1, 2)) > Limits.min_texture)


def _confirms(cell: Grey, window: Grey) -> bool:
    """Whether a cell correlates best, and well, with the middle of a window."""
    scores = np.asarray(cv2.matchTemplate(window, cell, cv2.TM_CCOEFF_NORMED))
    row, column = np.unravel_index(int(scores.argmax()), scores.shape)
    return bool(
        scores[row, column] >= Limits.min_correlation
        and np.hypot(row - _SEARCH_RADIUS, column - _SEARCH_RADIUS) <= Limits.max_offset
    )
