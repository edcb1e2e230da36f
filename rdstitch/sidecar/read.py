"""Reading a sidecar: a registration that was found before, checked field by field."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing import CompositeOptions
from rdstitch.crs import Crs
from rdstitch.errors import ArgumentError, InputError
from rdstitch.export.georeference import Georeference, Residual
from rdstitch.file_access import read_text
from rdstitch.local_alignment import DisplacementField
from rdstitch.outputs import Fingerprint, fingerprint, tiles_folder
from rdstitch.sidecar.write import VERSION

if TYPE_CHECKING:
    from rdstitch.sidecar.schema import ImageRecord, OutputRecord


@dataclass(frozen=True)
class SavedImage:
    """One image of a saved registration."""

    name: str  # name, path: as they were then
    path: str
    camera: Camera | None  # with everything that was estimated; None where the image could not be read
    # (3, 3): from undistorted coordinates, in half diagonals from the distortion centre, to the plane; None where the
    # image was left out
    to_plane: FloatArray | None
    reason: str  # why it was left out; empty where it was used
    # what local alignment found; None where the image was not aligned locally
    displacement: DisplacementField | None = None


@dataclass(frozen=True)
class SavedRegistration:
    """A registration as its sidecar tells it."""

    path: Path  # of the sidecar
    images: tuple[SavedImage, ...]
    reference: int  # the image whose resolution the output has
    distortion: float  # λ in the half-diagonal frame
    turned: bool  # whether the camera turned on the spot, so that ``to_plane`` leads to directions
    composite: CompositeOptions  # what the image was composited with
    orientation: FloatArray | None  # (3, 3): what the registered images were turned by to be at ``to_plane``
    place: Georeference | None  # of the plane, where the output was georeferenced
    content: dict[str, Any]  # the whole sidecar


def read_sidecar(path: str | Path) -> SavedRegistration:
    """Read a sidecar; every field that is there is checked."""
    # Imported late: no other command should wait for it.
    from rdstitch.records import convert, parse_json
    from rdstitch.sidecar.schema import SidecarRecord

    content = parse_json(read_text(path), str(path))
    if isinstance(content, dict) and isinstance(version := content.get("version"), int) and version > VERSION:
        raise InputError(f"{path}: version: this rdstitch reads versions 1 to {VERSION} of sidecars, not {version}")
    record = convert(content, SidecarRecord, str(path))
    unknown = [name for name in record.options.composite if name not in CompositeOptions.__dataclass_fields__]
    if unknown:
        raise InputError(f"{path}: options.composite.{unknown[0]}: this rdstitch has no such option")
    composite = convert(record.options.composite, CompositeOptions, str(path), "options.composite")
    turned = record.model == "rotation"
    if composite.projection == "auto" and turned:
        composite = replace(composite, projection=record.output.projection or "auto")
    images = tuple(map(_image, record.images))
    reference = next(k for k, image in enumerate(record.images) if image.name == record.reference and image.used)
    try:
        place = _place(record.output)
    except ArgumentError as error:
        raise InputError(f"{path}: output.georeference.crs: {error}") from error
    matrix = record.output.orientation
    orientation = None if matrix is None else np.array(matrix, dtype=np.float64)
    return SavedRegistration(
        Path(path), images, reference, record.lambda_, turned, composite, orientation, place, content
    )


def mismatch_with_image(saved: SavedRegistration) -> str:
    """Why the image beside a sidecar is not the one that it was written with; empty where it is, or is not there."""
    output = saved.content["output"]
    if output.get("sha256") is None or output.get("file") is None:
        return ""
    image = saved.path.with_name(output["file"])
    tiles = tiles_folder(image) if image.suffix.lower() == ".dzi" else None
    try:
        same = fingerprint(image, tiles) == Fingerprint(output.get("bytes"), output["sha256"])
    except OSError:
        return ""
    return "" if same else f"{image}: is not the image that {saved.path.name} was written with; one of them is newer"


def _place(output: "OutputRecord") -> Georeference | None:
    """Give where the plane lies on the Earth; versions before did not say."""
    record = output.georeference
    if record is None or record.crs is None or record.pixel_to_map is None or output.plane_to_output is None:
        return None
    (a, b, east), (_, _, north) = record.pixel_to_map
    place = Georeference(
        Crs(int(record.crs.removeprefix("EPSG:"))),
        complex(a, b),
        complex(east, north),
        record.rms_m,
        record.source,
        tuple(
            Residual(
                item.name,
                math.inf if item.east_m is None else item.east_m,
                math.inf if item.north_m is None else item.north_m,
                item.used,
            )
            for item in record.residuals
        ),
    )
    return place.after(np.linalg.inv(output.plane_to_output).astype(np.float64))


def _image(record: "ImageRecord") -> SavedImage:
    camera = None if record.size is None else record.lens(record.size)
    to_plane = np.array(record.to_plane, dtype=np.float64) if record.used else None
    moved, given = None, record.displacement
    if given is not None and record.used and camera is not None:
        columns, rows = given.grid
        nodes = np.array(given.px, dtype=np.float64).reshape(rows, columns, 2)
        moved = DisplacementField(camera.image_size, nodes)
    return SavedImage(record.name, record.path, camera, to_plane, record.reason, moved)
