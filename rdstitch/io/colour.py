"""Colours that are no RGB: CIELAB and inks become sRGB, which is what images without a profile are taken for."""

import io
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from rdstitch.arrays import AnyArray, FloatArray
from rdstitch.io.samples import ROWS_AT_A_TIME

if TYPE_CHECKING:
    from PIL import ImageCms

_WHITE = np.array([0.9642, 1.0, 0.8249])  # of D50, to which CIELAB in TIFF and in profiles refers
# From XYZ of D50, adapted to D65 after Bradford, to linear sRGB (IEC 61966-2-1).
_XYZ_TO_RGB = np.array(
    [[3.1338561, -1.6168667, -0.4906146], [-0.9787684, 1.9161415, 0.0334540], [0.0719453, -0.2289914, 1.4052427]]
)
_EDGE = 6.0 / 29.0  # where the cube root of CIE 1976 becomes a line


def srgb_of_lab(lab: AnyArray, *, signed: bool) -> AnyArray:
    """Samples of CIELAB (h, w, 3), 8 or 16 bits as TIFF stores them, as sRGB of the same type.

    In TIFF's own CIELAB a* and b* are signed; else they are offset by half of their range, as profiles have them.
    """
    rgb = np.empty_like(lab)
    for top in range(0, len(lab), ROWS_AT_A_TIME):
        rows = slice(top, top + ROWS_AT_A_TIME)
        rgb[rows] = _srgb_of_lab(lab[rows], signed=signed)
    return rgb


def _srgb_of_lab(lab: AnyArray, *, signed: bool) -> FloatArray:
    full = np.iinfo(lab.dtype).max
    unit = (full + 1) // 256
    chroma = lab[..., 1:].view(f"i{lab.dtype.itemsize}") if signed else lab[..., 1:].astype(np.int64) - 128 * unit
    y = (lab[..., 0] * (100.0 / (full if signed else 255 * unit)) + 16.0) / 116.0
    cube = np.stack([y + chroma[..., 0] / (500.0 * unit), y, y - chroma[..., 1] / (200.0 * unit)], axis=-1)
    xyz = np.where(cube > _EDGE, cube**3, 3.0 * _EDGE**2 * (cube - 4.0 / 29.0)) * _WHITE
    linear = np.clip(xyz @ _XYZ_TO_RGB.T, 0.0, 1.0)
    gamma = np.where(linear > 0.0031308, 1.055 * linear ** (1.0 / 2.4) - 0.055, 12.92 * linear)
    return np.asarray(np.rint(gamma * full))


def transform_to_srgb(profile: bytes, mode: str = "CMYK") -> "ImageCms.ImageCmsTransform | None":
    """What a colour profile, of inks (CMYK) or others, makes of samples in sRGB; None where it cannot be used."""
    from PIL import ImageCms

    try:
        return ImageCms.buildTransform(io.BytesIO(profile), ImageCms.createProfile("sRGB"), mode, "RGB")
    except (ImageCms.PyCMSError, ImportError):
        return None


def without_inks(image: Image.Image) -> Image.Image:
    """An image of inks in sRGB, by its colour profile where it has one; any other as it is."""
    profile = image.info.get("icc_profile")
    transform = transform_to_srgb(profile) if image.mode == "CMYK" and isinstance(profile, bytes) else None
    if transform is None:
        return image
    from PIL import ImageCms

    return ImageCms.applyTransform(image, transform) or image


def colour_space(profile: bytes) -> bytes:
    """What is equal of profiles of one colour space; images without one are taken for sRGB."""
    is_named_srgb = b"sRGB" in profile or b"s\0R\0G\0B" in profile
    return b"" if not profile or (is_named_srgb and not _is_linear(profile)) else profile


@lru_cache(maxsize=16)
def _is_linear(profile: bytes) -> bool:
    """Whether samples are proportional to light, as those of "linear sRGB" are: middle grey is 188 in sRGB then."""
    if (to_srgb := transform_to_srgb(profile, "RGB")) is None:
        return False
    from PIL import ImageCms

    grey = ImageCms.applyTransform(Image.new("RGB", (1, 1), (128, 128, 128)), to_srgb)
    return bool(np.asarray(grey).mean() > (128 + 188) / 2)
