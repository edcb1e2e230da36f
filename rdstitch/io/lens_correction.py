"""Images as the coefficients of their camera would have taken them, where its lens is another one."""

from dataclasses import replace

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, Float32Array, FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.io.read import DecodedImage

_NODES = 320  # along the width, at which the displacement is computed
_MAX_STEP = 8  # pixels between nodes
_ROWS = 512  # that are resampled at a time
_CHANNELS = 4  # that OpenCV resamples at once


def corrected(image: DecodedImage, camera: Camera, reduction: int) -> DecodedImage:
    """Resample an image of blocks of so many pixels a side from the lens of its camera to the camera's coefficients.

    What that lens does not show is transparent.
    """
    if camera.lens_model is None:
        return image
    height, width = image.pixels.shape[:2]
    pixels, opaque = np.empty_like(image.pixels), np.empty((height, width), np.uint8)
    alpha = np.full((height, width), 255, np.uint8) if image.alpha is None else image.alpha
    for top in range(0, height, _ROWS):
        rows = slice(top, min(top + _ROWS, height))
        at = _places(camera, reduction, top, rows.stop - top, width)
        inside = np.all((at >= -0.5) & (at <= np.array([width, height]) - 0.5), axis=-1)
        x, y = (np.where(inside, at[..., k], -1.0).astype(np.float32) for k in range(2))
        pixels[rows] = _resampled(image.pixels, x, y)
        shown = cv2.remap(alpha, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        opaque[rows] = np.where(inside, shown, 0)
    whole = image.alpha is None and bool(opaque.all())
    return replace(image, pixels=pixels, alpha=None if whole else opaque)


def _places(camera: Camera, reduction: int, top: int, count: int, width: int) -> FloatArray:
    """Where the lens shows the pixels of ``count`` rows, pixels (R, W, 2) of the image; NaN where it does not."""
    step = min(max(width // _NODES, 1), _MAX_STEP)
    # A step beyond each side: what is interpolated is never extrapolated.
    nodes = [np.arange(-1, -(-side // step) + 1) * step + (step - 1) / 2 for side in (width, count)]
    grid = np.stack(np.meshgrid(nodes[0], nodes[1] + top), axis=-1)
    offset = (reduction - 1) / 2
    assert camera.lens_model is not None
    with np.errstate(all="ignore"):
        shown = (camera.lens_model.distort(camera.undistort(grid * reduction + offset)) - offset) / reduction
    whole = cv2.resize(shown - grid, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
    pixel = np.stack(np.meshgrid(np.arange(width), np.arange(top, top + count)), axis=-1)
    return np.asarray(whole[step : step + count, step : step + width] + pixel)


def _resampled(pixels: AnyArray, x: Float32Array, y: Float32Array) -> AnyArray:
    """Samples (H, W) or (H, W, C) at places (R, W)."""
    if pixels.ndim == 3 and pixels.shape[2] > _CHANNELS:
        bands = [_resampled(np.ascontiguousarray(pixels[..., k]), x, y) for k in range(pixels.shape[2])]
        return np.stack(bands, axis=-1)
    done = cv2.remap(pixels, x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(done).reshape(*x.shape, *pixels.shape[2:])
