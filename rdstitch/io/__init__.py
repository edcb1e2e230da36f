"""Images in and out, with their metadata, and nothing half-written."""

from rdstitch.geometry.places import GpsPosition
from rdstitch.io.attitude import Attitude
from rdstitch.io.formats import check_format, check_size
from rdstitch.io.metadata import Metadata, read_metadata
from rdstitch.io.read import DecodedImage, read_image
from rdstitch.io.strips import ImageSpec
from rdstitch.io.write import write_image, write_strips

__all__ = [
    "Attitude",
    "DecodedImage",
    "GpsPosition",
    "ImageSpec",
    "Metadata",
    "check_format",
    "check_size",
    "read_image",
    "read_metadata",
    "write_image",
    "write_strips",
]
