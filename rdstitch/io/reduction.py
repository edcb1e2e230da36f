"""Pictures made smaller by a whole factor, such that px of the small one stand for whole blocks of the large one."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def fitting_reduction(shrink: float) -> int:
    """The largest of the factors 1, 2, 4 and 8, which are cheap for JPEG files, that is no more than ``shrink``."""
    return next((factor for factor in (8, 4, 2) if factor <= shrink), 1)


def reduced_size(size: tuple[int, int], factor: int) -> tuple[int, int]:
    """Width and height, px, of a picture that is reduced by ``factor``; the last block need not be whole."""
    return -(-size[0] // factor), -(-size[1] // factor)


def block_mean(samples: NDArray[Any], factor: int) -> NDArray[Any]:
    """Mean over blocks of ``factor`` x ``factor`` px of samples (h, w) or (h, w, C); borders repeat themselves."""
    if factor == 1:
        return samples
    height, width = samples.shape[:2]
    down, right = -height % factor, -width % factor
    whole = cv2.copyMakeBorder(samples, 0, down, 0, right, cv2.BORDER_REPLICATE) if down or right else samples
    columns, rows = reduced_size((width, height), factor)
    done = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(done).reshape(rows, columns, *samples.shape[2:])


def block_minimum(alpha: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Least value in blocks of ``factor`` x ``factor`` px of a plane (h, w): opaque where all of a block is."""
    if factor == 1:
        return alpha
    height, width = alpha.shape
    whole = np.pad(alpha, [(0, -height % factor), (0, -width % factor)], mode="edge")
    columns, rows = reduced_size((width, height), factor)
    return np.asarray(whole.reshape(rows, factor, columns, factor).min(axis=(1, 3)))


def halved(strip: NDArray[Any], transparent: bool) -> NDArray[Any]:
    """Mean of 2 x 2 px of samples (h, w, C), weighted by the alpha that the last channel is where it is transparent.

    An odd border repeats itself. Halves are rounded up, in every strip alike.
    """
    full = np.iinfo(strip.dtype).max if strip.dtype.kind == "u" else 1.0
    even = np.pad(strip, [(0, strip.shape[0] % 2), (0, strip.shape[1] % 2), (0, 0)], mode="edge")
    four = [even[y::2, x::2] for y in (0, 1) for x in (0, 1)]
    if strip.dtype.kind == "u" and (not transparent or (strip[..., -1] == full).all()):
        wide = np.uint16 if strip.dtype == np.uint8 else np.uint32
        total: NDArray[Any] = np.add(four[0], four[1], dtype=wide)
        total += four[2]
        total += four[3]
        total += wide(2)
        total >>= wide(2)
        return total.astype(strip.dtype)
    corners = np.stack(four).astype(np.float32)
    mean: NDArray[Any] = corners.mean(axis=0)
    if not transparent:
        return mean.astype(strip.dtype)
    share = corners[..., -1:] / np.float32(full)
    mean[..., :-1] = (corners[..., :-1] * share).sum(axis=0) / np.maximum(share.sum(axis=0), np.float32(1e-6))
    if strip.dtype.kind == "u":
        np.floor(mean + np.float32(0.5), out=mean)
    return np.ascontiguousarray(mean.astype(strip.dtype))
