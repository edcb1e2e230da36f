"""Small pictures inside the page, as data addresses."""

import base64
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from rdstitch.errors import InputError
from rdstitch.inputs.source import Source
from rdstitch.io.preview import encode_preview, read_preview
from rdstitch.io.reduction import fitting_reduction
from rdstitch.stitch_result import StitchResult


def of_source(source: Source, side: int) -> str | None:
    """A thumbnail of an input picture; None where it is gone, as frames of videos are."""
    try:
        reduction = fitting_reduction(max(source.camera.image_size) / (2 * side))
        return data_address(source.read(reduction).pixels, side)
    except InputError:
        return None


def of_mosaic(result: StitchResult, side: int, staged: Path | None = None) -> str | None:
    """A thumbnail of the output, or of its staged file; None where there is none, as after a dry run."""
    if result.composite is not None:
        return data_address(result.composite.pixels, side)
    file = staged or result.output
    if file is None or not file.exists():
        return None
    return data_address(read_preview(file, result.canvas.size, side)[0], side)


def data_address(pixels: NDArray[Any], side: int) -> str:
    """A picture of any sample type as JPEG inside a ``data:`` address, its longer side at most ``side`` pixels."""
    return "data:image/jpeg;base64," + base64.b64encode(encode_preview(pixels, side)).decode("ascii")
