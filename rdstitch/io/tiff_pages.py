"""Which pages of a TIFF file are its images: others are masks and overviews of them."""

from collections.abc import Iterator
from itertools import islice

from rdstitch.io.ome import OmeImage, read_ome
from rdstitch.system.late_imports import tifffile


def image_pages(tiff: "tifffile.TiffFile") -> Iterator["tifffile.TiffPage"]:
    """The pages of a file that are images of their own; the first page always is."""
    yield tiff.pages.first
    for number in range(1, len(tiff.pages)):  # which goes through the whole file
        page = tiff.pages[number]
        page = page if isinstance(page, tifffile.TiffPage) else page.aspage()
        if not (page.is_reduced or page.is_mask):
            yield page


def first_image_pages(tiff: "tifffile.TiffFile", ome: OmeImage | None = None) -> list["tifffile.TiffPage"]:
    """The pages of the first image: one, or those of all channels where an OME-TIFF has these on pages of their own."""
    ome = ome or read_ome(tiff.ome_metadata)
    count = 1 if ome is None else max(1, ome.channels)
    pages = list(islice(image_pages(tiff), count))
    alike = len({(page.shape, page.dtype) for page in pages}) == 1 and pages[0].axes == "YX"
    return pages if len(pages) == count and alike else pages[:1]
