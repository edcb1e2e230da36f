"""Writing a picture: JPEG, PNG, TIFF or WebP by the suffix, whole or not at all, with profile and EXIF."""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rdstitch.errors import ArgumentError, LimitError, OutputError
from rdstitch.io.atomic import PICTURE_SUFFIXES, atomic_output
from rdstitch.io.embedding import embed_in_jpeg, embed_in_png
from rdstitch.io.metadata import Metadata

Pixels = NDArray[Any]

# Width and height that the formats (or their one encoder) can hold.
SIDE_LIMITS = {".jpg": 65500, ".jpeg": 65500, ".webp": 16383, ".png": 1_000_000}
_WEBP_QUALITY_STEP = 4


def write_image(
    path: str | Path,
    pixels: Pixels,
    alpha: NDArray[np.uint8] | None = None,
    metadata: Metadata | None = None,
    *,
    quality: int = 95,
    background: int = 0,
) -> None:
    """Write a picture; the format follows the suffix.

    The same input gives the same bytes. JPEG has no transparency and 8 bits: what is transparent becomes
    ``background``, 16 bits are rounded to 8.

    Parameters
    ----------
    path
        ``.jpg``, ``.jpeg``, ``.png``, ``.tif``, ``.tiff`` or ``.webp``.
    pixels : ndarray of shape (H, W) or (H, W, C), uint8, uint16 or float32
        Colour in RGB order. Floating-point samples and more than three channels need TIFF.
    alpha : ndarray of shape (H, W), uint8, optional
        255 where the picture is opaque.
    metadata : Metadata, optional
        Colour profile, EXIF and resolution to keep.
    quality : int
        Of JPEG and WebP, 1 to 100.
    background : int
        Grey of what is transparent, in a format without transparency: 0 black, 255 white.

    Raises
    ------
    ArgumentError
        When the arrays do not fit together.
    LimitError
        When the picture is too large for the format; the text names one that holds it.
    OutputError
        When the format cannot hold such samples, or the file system refuses; nothing is left behind.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    _check(file, suffix, pixels, alpha)
    described = metadata or Metadata((pixels.shape[1], pixels.shape[0]))
    if suffix in (".tif", ".tiff"):
        from rdstitch.io.tiff import write_tiff

        write_tiff(file, pixels, alpha, described)
        return
    if suffix in (".jpg", ".jpeg"):
        data = embed_in_jpeg(_jpeg(pixels, alpha, quality, background), described)
    elif suffix == ".png":
        data = embed_in_png(_png(pixels, alpha), described)
    else:
        data = [_webp(pixels, alpha, quality, described)]
    with atomic_output(file) as temporary, temporary.open("wb") as stream:
        stream.writelines(data)


def check_size(path: str | Path, size: tuple[int, int]) -> None:
    """Refuse a picture of ``size`` (width, height) that the format of ``path`` cannot hold.

    Raises
    ------
    LimitError
        The text names a format that holds it.
    """
    suffix = Path(path).suffix.lower()
    limit = SIDE_LIMITS.get(suffix)
    if limit is not None and max(size) > limit:
        raise LimitError(
            f"{path}: {size[0]} x {size[1]} px is more than {suffix[1:]} can hold ({limit} px a side); "
            "write a .tif, or use a smaller --scale"
        )


def _check(file: Path, suffix: str, pixels: Pixels, alpha: NDArray[np.uint8] | None) -> None:
    """Refuse what cannot be written before any work is done."""
    if suffix not in PICTURE_SUFFIXES:
        raise OutputError(f"{file}: unknown file type '{suffix}'; use one of {' '.join(PICTURE_SUFFIXES)}")
    if pixels.ndim not in (2, 3) or pixels.size == 0:
        raise ArgumentError(f"expected pixels of shape (H, W) or (H, W, C), not {pixels.shape}")
    if alpha is not None and (alpha.shape != pixels.shape[:2] or alpha.dtype != np.uint8):
        raise ArgumentError(f"alpha must be uint8 of shape {pixels.shape[:2]}, not {alpha.dtype} {alpha.shape}")
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise ArgumentError(f"pixels must be uint8, uint16 or float32, not {pixels.dtype}")
    if suffix not in (".tif", ".tiff"):
        if pixels.ndim == 3 and pixels.shape[2] not in (1, 3):
            raise OutputError(f"{file}: {pixels.shape[2]} channels do not fit into {suffix[1:]}; write a .tif")
        if pixels.dtype == np.float32:
            raise OutputError(f"{file}: floating-point samples do not fit into {suffix[1:]}; write a .tif")
        check_size(file, (pixels.shape[1], pixels.shape[0]))


def _bgr(pixels: Pixels) -> Pixels:
    """Contiguous array as OpenCV wants it; no copy where the RGB array is a view of a BGR one."""
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        return np.ascontiguousarray(pixels.reshape(pixels.shape[:2]))
    return np.ascontiguousarray(pixels[..., ::-1])


def _eight_bit(pixels: Pixels) -> Pixels:
    """16 bits rounded to 8."""
    if pixels.dtype == np.uint8:
        return pixels
    return ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)


def _jpeg(pixels: Pixels, alpha: NDArray[np.uint8] | None, quality: int, background: int) -> NDArray[np.uint8]:
    """JPEG file in memory."""
    samples = _bgr(_eight_bit(pixels))
    if alpha is not None and not bool(alpha.all()):
        if np.shares_memory(samples, pixels):
            samples = samples.copy()
        samples[alpha == 0] = background
    return _encode(".jpg", samples, [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 0])


def _png(pixels: Pixels, alpha: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """PNG file in memory; grey with alpha is written as colour with alpha."""
    samples = _bgr(pixels)
    if alpha is not None:
        full = alpha if pixels.dtype == np.uint8 else alpha.astype(np.uint16) * np.uint16(257)
        colour = (samples,) * 3 if samples.ndim == 2 else tuple(samples[..., k] for k in range(3))
        samples = cv2.merge([np.ascontiguousarray(plane) for plane in (*colour, full)])
    return _encode(".png", samples, [cv2.IMWRITE_PNG_COMPRESSION, 4])


def _encode(suffix: str, samples: Pixels, options: list[int]) -> NDArray[np.uint8]:
    """Encoded by OpenCV.

    Raises
    ------
    LimitError
        When the encoder gives up; sizes and types have been checked before.
    """
    try:
        done, data = cv2.imencode(suffix, samples, options)
    except cv2.error as error:
        raise LimitError(
            f"cannot encode {samples.shape[1]} x {samples.shape[0]} px as {suffix[1:]}: {error.err}"
        ) from error
    if not done:
        raise LimitError(f"cannot encode {samples.shape[1]} x {samples.shape[0]} px as {suffix[1:]}; write a .tif")
    return np.asarray(data, dtype=np.uint8)


def _webp(pixels: Pixels, alpha: NDArray[np.uint8] | None, quality: int, metadata: Metadata) -> bytes:
    """WebP file in memory."""
    samples = _eight_bit(pixels)
    if samples.ndim == 2 or samples.shape[2] == 1:
        samples = np.repeat(samples.reshape(*samples.shape[:2], 1), 3, axis=2)
    if alpha is not None:
        samples = np.dstack([samples, alpha])
    stream = io.BytesIO()
    image = Image.fromarray(np.ascontiguousarray(samples))
    image.save(
        stream, "WEBP", quality=quality, method=_WEBP_QUALITY_STEP, exif=metadata.exif, icc_profile=metadata.icc_profile
    )
    return stream.getvalue()
