"""What belongs to the camera and not to the plane: a black border, a robot's own body, a pasted banner or caption.

It is at the same place in every image. A border has the lowest level, whichever that is, in all of them, from the edge
of the image to where they show something else. Texture that stays has the same corners in all images, whereas those of
the plane are at other places in each. Edges do not count: a rail along the motion stays too. Nor do even areas, but
those beside them along the border belong to them: the band and the scale bar of a caption.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, BoolArray, Float32Array
from rdstitch.io.reduction import mean_of_channels

MIN_IMAGES = 4  # fewer may show the same by chance
_SAME = 0.02  # of the images' contrast, up to which levels are the same
_CONTRAST = (0.1, 99.9)  # percentiles
_MIN_AREA = 0.005  # of the image, for a region to count
_MAX_AREA = 0.6  # of the image: where more than this seems to stay, the images differ too little to say
_STAYS = 0.5  # agreement of the corners of the images: 1 for what stays, about 0 for what moves
_MIN_TEXTURE = 0.1  # of what is usual in the images, for corners to count
_WINDOW = 0.05  # of the longer side, over which corners are compared


def static_pixels(images: Sequence[AnyArray]) -> BoolArray | None:
    """Which pixels show what stays at its place in all images.

    The images, at least :data:`MIN_IMAGES` of one camera that moved between them, are some hundred pixels wide. None
    where nothing stays, or so much that the camera hardly moved.
    """
    grey = np.stack([mean_of_channels(image.astype(np.float32)) for image in images])
    window = max(3, round(_WINDOW * max(grey.shape[1:])))
    low, high = np.percentile(grey, _CONTRAST)
    same = _SAME * max(float(high - low), 1e-12)
    # What is between the corners of a body belongs to it.
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (window | 1, window | 1))
    closed = cv2.morphologyEx((_agreement(grey, window) > _STAYS).astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    static = _border(grey <= low + same, window) | _regions(cv2.morphologyEx(closed, cv2.MORPH_OPEN, kernel) > 0)
    static = _with_captions(static, np.ptp(grey, axis=0) <= same, window)
    fraction = float(static.mean())
    return static if _MIN_AREA < fraction < _MAX_AREA else None


def _agreement(grey: Float32Array, window: int) -> Float32Array:
    """How far the corners of different images agree, over a window, shape (h, w): 1 for what stays, else about 0."""
    within_images: Float32Array = np.zeros((3, *grey.shape[1:]), np.float32)
    total: Float32Array = np.zeros((2, *grey.shape[1:]), np.float32)
    for image in grey:
        slope = np.stack([cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1)])
        within_images += _tensor(slope)
        total += slope
    # Products of the slopes of one image with those of all others, against those with its own.
    others = (_tensor(total) - within_images) / np.float32(len(grey) - 1)
    corners, common = (_smaller_eigenvalue(tensor, window) for tensor in (within_images, others))
    return np.asarray(common / np.maximum(corners, _MIN_TEXTURE * np.median(corners) + 1e-12), np.float32)


def _tensor(slope: Float32Array) -> Float32Array:
    return np.stack([slope[0] ** 2, slope[1] ** 2, slope[0] * slope[1]])


def _smaller_eigenvalue(tensor: Float32Array, window: int) -> Float32Array:
    """Smaller eigenvalue of the structure tensor (3, h, w), averaged over a window."""
    xx, yy, xy = (cv2.boxFilter(part, -1, (window, window)) for part in tensor)
    return np.asarray((xx + yy) / 2.0 - np.sqrt(((xx - yy) / 2.0) ** 2 + xy**2))


def _with_captions(static: BoolArray, same: BoolArray, window: int) -> BoolArray:
    """The same with what is ``same`` in all images in a strip along the border that is nearest to it.

    Only in pieces larger than any outside of such strips: of white paper, sameness says nothing.
    """
    strips, (height, width) = np.zeros_like(static), static.shape
    for x, y, w, h in cv2.connectedComponentsWithStats(static.astype(np.uint8))[2][1:, :4].tolist():
        if min(y, height - y - h) <= min(x, width - x - w):
            strips[max(y - window, 0) : y + h + window] = True
        else:
            strips[:, max(x - window, 0) : x + w + window] = True
    parts = (same & strips & ~static, same & ~strips)
    pieces = [cv2.connectedComponentsWithStats(part.astype(np.uint8)) for part in parts]
    (_, labels, inside, _), (_, _, outside, _) = pieces
    large = np.flatnonzero(inside[:, cv2.CC_STAT_AREA] > outside[1:, cv2.CC_STAT_AREA].max(initial=0))
    captions = np.isin(labels, large[large > 0]) & (not strips.all())
    return static | (cv2.dilate(captions.astype(np.uint8), np.ones((5, 5), dtype=np.uint8)) > 0)


def _border(dark: BoolArray, window: int) -> BoolArray:
    """Regions at the edge that are dark in all images (N, h, w), and end where most of these are not.

    What is dark in all by chance (the ground of a microscope, a shadow) ends where the first of them is not.
    """
    dark_regions = _regions(np.asarray(dark.all(axis=0)))
    _, labels = cv2.connectedComponents(dark_regions.astype(np.uint8))
    border = np.zeros_like(dark_regions)
    for label in set(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]).tolist()) - {0}:
        region = labels == label
        beyond = (
            cv2.dilate(region.astype(np.uint8), np.ones((window, window), np.uint8)).astype(np.bool_) & ~dark_regions
        )
        if beyond.any() and dark[:, beyond].mean() < 0.5:
            border |= region
    return border


def _regions(candidates: BoolArray) -> BoolArray:
    """The connected regions that are large enough; grown by two pixels."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(candidates.astype(np.uint8))
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= _MIN_AREA * candidates.size]
    kept = np.isin(labels, large).astype(np.uint8)
    return np.asarray(cv2.dilate(kept, np.ones((5, 5), dtype=np.uint8)), dtype=np.bool_)
