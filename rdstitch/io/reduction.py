"""Images made smaller by a whole factor: a pixel of the small one stands for a whole block of the large one."""

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, Float32Array, UInt8Array


def fitting_reduction(shrink: float) -> int:
    """The largest of the factors 1, 2, 4 and 8, which are cheap for JPEG files, that is no more than ``shrink``."""
    return next((factor for factor in (8, 4, 2) if factor <= shrink), 1)


def reduced_size(size: tuple[int, int], factor: int) -> tuple[int, int]:
    """Width and height, pixels, of an image that is reduced by ``factor``; the last block need not be whole."""
    return -(-size[0] // factor), -(-size[1] // factor)


def block_mean(samples: AnyArray, factor: int) -> AnyArray:
    """Mean over blocks of ``factor`` x ``factor`` pixels of samples (h, w) or (h, w, C); borders repeat themselves."""
    if factor == 1:
        return samples
    height, width = samples.shape[:2]
    down, right = -height % factor, -width % factor
    whole = cv2.copyMakeBorder(samples, 0, down, 0, right, cv2.BORDER_REPLICATE) if down or right else samples
    columns, rows = reduced_size((width, height), factor)
    done = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(done).reshape(rows, columns, *samples.shape[2:])


def mean_of_channels(samples: Float32Array) -> Float32Array:
    """Mean over the channels, up to 128, of samples (h, w) or (h, w, C); faster than NumPy, for three fifty times."""
    if samples.ndim == 2:
        return samples
    channels = samples.shape[2]
    return np.asarray(cv2.transform(samples, np.full((1, channels), 1.0 / channels)), dtype=np.float32)


def block_minimum(alpha: UInt8Array, factor: int) -> UInt8Array:
    """Least value in blocks of ``factor`` x ``factor`` pixels of a plane (h, w): opaque where all of a block is."""
    if factor == 1:
        return alpha
    height, width = alpha.shape
    whole = np.pad(alpha, [(0, -height % factor), (0, -width % factor)], mode="edge")
    columns, rows = reduced_size((width, height), factor)
    return np.asarray(whole.reshape(rows, factor, columns, factor).min(axis=(1, 3)))


def halved(strip: AnyArray, transparent: bool) -> AnyArray:
    """Mean of 2 x 2 pixels (h, w, C), weighted by the alpha that the last channel is where it is transparent.

    An odd border repeats itself. Halves are rounded up, in every strip alike.
    """
    even = np.pad(strip, [(0, strip.shape[0] % 2), (0, strip.shape[1] % 2), (0, 0)], mode="edge")
    four = [even[y::2, x::2] for y in (0, 1) for x in (0, 1)]
    if strip.dtype.kind == "f":
        return _weighted_mean(np.stack(four), transparent)
    # OpenCV rounds halves up only with 1, 3 or 4 channels.
    channels = strip.shape[2]
    whole = (slice(None),) if channels in (1, 3, 4) else tuple(slice(k, k + 1) for k in range(channels))
    mean = np.concatenate([block_mean(np.ascontiguousarray(even[..., part]), 2) for part in whole], axis=2)
    if transparent and not (mean[..., -1] == np.iinfo(strip.dtype).max).all():
        partly = (mean[..., -1] != 0) & (mean[..., -1] != np.iinfo(strip.dtype).max)
        mean[partly] = _weighted_mean(np.stack([corner[partly] for corner in four]), transparent)
        mean[mean[..., -1] == 0] = 0
    return mean


def _weighted_mean(corners: AnyArray, transparent: bool) -> AnyArray:
    """Mean over the first axis of samples (4, ..., C), weighted by the last channel where that is alpha."""
    integer = corners.dtype.kind == "u"
    values = corners.astype(np.float32)
    mean: AnyArray = values.mean(axis=0)
    if transparent:
        opacity = values[..., -1:] / np.float32(np.iinfo(corners.dtype).max if integer else 1.0)
        mean[..., :-1] = (values[..., :-1] * opacity).sum(axis=0) / np.maximum(opacity.sum(axis=0), np.float32(1e-6))
    if integer:
        np.floor(mean + np.float32(0.5), out=mean)
    return np.ascontiguousarray(mean.astype(corners.dtype))
