"""Records that the sidecars of a new image, and of one that was composed again, have in common."""

import os
import platform
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.compositing import Canvas, SeamQuality
from rdstitch.compositing.panorama_canvas import center_of_view, field_of_view
from rdstitch.compositing.projection import PLANE
from rdstitch.georeferencing.georeference import Georeference, Residual
from rdstitch.inputs.source import Source
from rdstitch.local_alignment import DisplacementField
from rdstitch.results.stitch_result import OutputImage
from rdstitch.sidecar.records import (
    BreakRecord,
    Displacement,
    GeoreferenceRecord,
    OutputRecord,
    ResidualRecord,
    SeamsRecord,
)


def recorded_path(path: Path, output: Path | None) -> str:
    """A file as the sidecar of an output has it, from its folder on; an absolute name, or what is no file, as it is."""
    return rebased_path(path, Path(), output) if path.exists() else str(path)


def rebased_path(path: Path, folder: Path, output: Path | None) -> str:
    """A path from a folder on, as one from the folder of an output on; an absolute one as it is."""
    if output is None or path.is_absolute():
        return str(folder / path)
    named, target = (folder / path.parent).resolve() / path.name, output.parent.resolve()
    return str(named) if named.drive != target.drive else Path(os.path.relpath(named, target)).as_posix()


def taken_fields(source: Source) -> dict[str, Any]:
    """When and where an image was taken, as fields of its record."""
    gps = source.metadata.gps
    return {
        "timestamp": source.metadata.timestamp,
        "gps": None if gps is None else (gps.latitude, gps.longitude, gps.altitude),
    }


def output_record(output: OutputImage, *, turned: bool) -> OutputRecord:
    """The output: by size and digest a reader sees whether the sidecar still belongs to it."""
    canvas, written = output.canvas, output.fingerprint
    return OutputRecord(
        file=None if output.output is None else output.output.name,
        bytes=None if written is None else written.size,
        sha256=None if written is None else written.sha256,
        size=canvas.size,
        plane_to_output=to_lists(canvas.matrix),
        projection=canvas.projection.name,
        orientation=to_lists(canvas.orientation),
        wraps_around=canvas.period is not None,
        field_of_view_deg=in_degrees(field_of_view(canvas)) if turned else None,
        center_deg=in_degrees(center_of_view(canvas)) if turned else None,
        georeference=_georeference(output.georeference, output.not_georeferenced),
    )


def _georeference(place: Georeference | None, reason: str) -> GeoreferenceRecord:
    if place is None:
        return GeoreferenceRecord(reason=reason)
    return GeoreferenceRecord(
        crs=f"EPSG:{place.crs.epsg}",
        gsd_m=place.gsd,
        pixel_to_map=to_lists(place.pixel_to_map),
        north_up=place.north_up,
        source=place.source,
        positions=len(place.residuals),
        positions_used=place.used,
        rms_m=place.rms,
        std_m=place.std,
        residuals=_residuals(place.residuals),
        check_points=_residuals(place.checks),
    )


def _residuals(residuals: Iterable[Residual]) -> list[ResidualRecord]:
    return [ResidualRecord(each.name, each.east, each.north, each.used) for each in residuals]


def seams_record(seams: SeamQuality, names: Sequence[str]) -> SeamsRecord:
    """Where the seams of an output hold and where they break; ``names`` are those of its images."""
    breaks = [
        BreakRecord((names[each.images[0]], names[each.images[1]]), *each.position, each.length, each.size)
        for each in seams.breaks
    ]
    return SeamsRecord(len(seams.places), int(seams.broken.sum()), breaks)


def to_output(canvas: Canvas, homography: FloatArray) -> Any:
    """From undistorted coordinates to pixels of the output, where one matrix can say that: on a plane."""
    return to_lists(canvas.matrix @ homography) if canvas.projection == PLANE else None


def displacement_record(field: DisplacementField | None) -> Displacement | None:
    if field is None:
        return None
    rows, columns, _ = field.values.shape
    return Displacement((columns, rows), to_lists(field.values.reshape(-1, 2)))


def versions() -> dict[str, str]:
    """Versions of what has a say in the result."""
    from importlib.metadata import version

    import scipy

    return {
        "rdstitch": version("rdstitch"),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        # Whichever of its wheels is installed.
        "opencv": cv2.__version__,
        "python": platform.python_version(),
    }


def to_lists(array: FloatArray | None) -> Any:
    """An array as lists, of which the JSON of a record has tuples."""
    return None if array is None else array.tolist()


def in_degrees(angles: Any) -> Any:
    return None if angles is None else np.degrees(angles).tolist()
