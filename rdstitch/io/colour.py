"""Colours of inks become sRGB, which is what images without a profile are taken for."""

import io

from PIL import Image, ImageCms


def ink_transform(profile: bytes) -> ImageCms.ImageCmsTransform | None:
    """What a colour profile of inks (CMYK) makes of them in sRGB; None where it cannot be used."""
    try:
        return ImageCms.buildTransform(io.BytesIO(profile), ImageCms.createProfile("sRGB"), "CMYK", "RGB")
    except (ImageCms.PyCMSError, ImportError):
        return None


def without_inks(image: Image.Image) -> Image.Image:
    """An image of inks in sRGB, by its colour profile where it has one; any other as it is."""
    profile = image.info.get("icc_profile")
    transform = ink_transform(profile) if image.mode == "CMYK" and isinstance(profile, bytes) else None
    return image if transform is None else ImageCms.applyTransform(image, transform) or image


def colour_space(profile: bytes) -> bytes:
    """What is equal of profiles of one colour space; images without one are taken for sRGB."""
    if not profile or b"sRGB" in profile or b"s\0R\0G\0B" in profile:
        return b""
    return profile
