"""What is written: an image in strips from top to bottom."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.errors import ArgumentError
from rdstitch.io.metadata import Metadata

# Samples (h, W, C) and alpha (h, W), uint8, or None for opaque.
Strip = tuple[AnyArray, UInt8Array | None]

# Strips but the last have a multiple of this many rows: what JPEG (128) and TIFF tiles (256) need.
STRIP_ROWS = 256


@dataclass(frozen=True)
class ImageSpec:
    """The form of an image that comes in strips."""

    size: tuple[int, int]  # width and height, pixels
    channels: int  # colour channels, without alpha
    dtype: np.dtype[Any]  # uint8, uint16 or float32
    transparent: bool = False  # whether there is an alpha channel, if the format can hold one
    metadata: Metadata = field(default_factory=lambda: Metadata((1, 1)))  # colour profile, EXIF and resolution to keep
    quality: int = 95  # of JPEG and WebP, 1 to 100
    background: int = 0  # grey (0 to 255) of what is transparent, in a format without transparency

    def __post_init__(self) -> None:
        if min(self.size) < 1 or self.channels < 1:
            raise ArgumentError(
                f"an image of {self.size[0]} x {self.size[1]} pixels and {self.channels} channels is empty"
            )
        if self.dtype not in (np.uint8, np.uint16, np.float32):
            raise ArgumentError(f"pixels must be uint8, uint16 or float32, not {self.dtype}")

    @property
    def samples_per_pixel(self) -> int:
        """Channels with alpha."""
        return self.channels + self.transparent


def check_strips(spec: ImageSpec, strips: Iterable[Strip]) -> Iterator[Strip]:
    """The strips, when they are what the spec says."""
    width, height = spec.size
    rows = 0
    for samples, alpha in strips:
        if samples.shape[1:] != (width, spec.channels) or samples.dtype != spec.dtype:
            raise ArgumentError(f"a strip of {samples.dtype} {samples.shape} does not fit into {spec.size}")
        if alpha is not None and (alpha.shape != samples.shape[:2] or alpha.dtype != np.uint8):
            raise ArgumentError(f"alpha must be uint8 of shape {samples.shape[:2]}, not {alpha.dtype} {alpha.shape}")
        if rows % STRIP_ROWS:
            raise ArgumentError(f"strips but the last must have a multiple of {STRIP_ROWS} rows")
        rows += len(samples)
        yield samples, alpha
    if rows != height:
        raise ArgumentError(f"{rows} of {height} rows were given")


def zero_uncovered(strips: Iterable[Strip]) -> Iterator[AnyArray]:
    """The samples of strips, 0 where nothing covers them."""
    for samples, alpha in strips:
        yield samples if alpha is None else np.where(alpha[..., None] > 0, samples, 0)


def placed_rows(parts: Iterable[AnyArray]) -> Iterator[tuple[slice, AnyArray]]:
    """Parts of an image from top to bottom, and which rows of it they are."""
    top = 0
    for rows in parts:
        yield slice(top, top + len(rows)), rows
        top += len(rows)


def as_eight_bit(samples: AnyArray) -> UInt8Array:
    """16 bits rounded to 8."""
    if samples.dtype == np.uint8:
        return np.asarray(samples, dtype=np.uint8)
    return ((samples.astype(np.uint32) + 128) // 257).astype(np.uint8)


def with_alpha(samples: AnyArray, alpha: UInt8Array | None) -> AnyArray:
    """Samples (h, W, C) with alpha as one channel more, in the samples' type."""
    full = np.iinfo(samples.dtype).max if samples.dtype.kind == "u" else 1.0
    if alpha is None:
        opacity = np.full(samples.shape[:2], full, dtype=samples.dtype)
    else:
        opacity = alpha * samples.dtype.type(full / 255)
    # numpy is slow along an axis of three.
    return np.asarray(cv2.merge([samples, opacity]))
