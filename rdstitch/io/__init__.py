"""Files in and out: pictures with their metadata, sidecars, and nothing half-written."""

from rdstitch.io.atomic import atomic_output, check_output, write_json_atomic, write_text_atomic
from rdstitch.io.attitude import Attitude
from rdstitch.io.layout import Layout
from rdstitch.io.metadata import GpsPosition, Metadata, read_metadata
from rdstitch.io.read import Picture, read_image
from rdstitch.io.write import check_format, check_size, write_image, write_strips

__all__ = [
    "Attitude",
    "GpsPosition",
    "Layout",
    "Metadata",
    "Picture",
    "atomic_output",
    "check_format",
    "check_output",
    "check_size",
    "read_image",
    "read_metadata",
    "write_image",
    "write_json_atomic",
    "write_strips",
    "write_text_atomic",
]
