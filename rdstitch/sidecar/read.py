"""Reading a sidecar: a registration that was found before, checked field by field."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import FOCAL_LOG_STD, Camera
from rdstitch.camera_record import read_lens
from rdstitch.compositing import CompositeOptions
from rdstitch.compositing.options import PROJECTIONS
from rdstitch.errors import ArgumentError
from rdstitch.export.crs import Crs
from rdstitch.export.georeference import Georeference
from rdstitch.io.deepzoom import tiles_folder
from rdstitch.io.fingerprint import Fingerprint, fingerprint
from rdstitch.local_alignment import DisplacementField
from rdstitch.records import Record, read_json
from rdstitch.sidecar.write import VERSION


@dataclass(frozen=True)
class SavedImage:
    """One image of a saved registration.

    Attributes
    ----------
    name, path : str
        As they were then.
    camera : Camera or None
        With everything that was estimated; None where the image could not be read.
    to_plane : ndarray of shape (3, 3), or None
        From undistorted coordinates, in half diagonals from the distortion centre, to the plane; None where the image
        was left out.
    reason : str
        Why it was left out; empty where it was used.
    displacement : DisplacementField or None
        What local alignment found; None where the image was not aligned locally.
    """

    name: str
    path: str
    camera: Camera | None
    to_plane: FloatArray | None
    reason: str
    displacement: DisplacementField | None = None


@dataclass(frozen=True)
class SavedRegistration:
    """A registration as its sidecar tells it.

    Attributes
    ----------
    path : Path
        Of the sidecar.
    images : tuple of SavedImage
    reference : int
        The image whose resolution the output has.
    distortion : float
        λ in the half-diagonal frame.
    turned : bool
        Whether the camera turned on the spot, so that ``to_plane`` leads to directions.
    composite : CompositeOptions
        What the image was composited with.
    place : Georeference or None
        Of the plane, where the output was georeferenced.
    content : dict
        The whole sidecar.
    """

    path: Path
    images: tuple[SavedImage, ...]
    reference: int
    distortion: float
    turned: bool
    composite: CompositeOptions
    place: Georeference | None
    content: dict[str, Any]


def read_sidecar(path: str | Path) -> SavedRegistration:
    """Read a sidecar; fields that recomposing does not need are kept but not looked into.

    Raises
    ------
    InputError
        When the file cannot be read, is no sidecar, or a field is not what it should be; the text names both.
    """
    record = read_json(path)
    if (kind := record["format"]).value != "rdstitch sidecar":
        kind.expected('"rdstitch sidecar"')
    if (version := record["version"]).value not in range(1, VERSION + 1):
        version.fail(f"this rdstitch reads versions 1 to {VERSION} of sidecars, not {version.value}")
    record["verdict"].fields()
    _check_output(record["output"])
    images = tuple(_image(item) for item in record["images"].items())
    return SavedRegistration(
        Path(path),
        images,
        _reference(record["reference"], images),
        record["lambda"].number(),
        record["model"].text() == "rotation",
        _as_laid_out(_composite_options(record["options"]["composite"]), record),
        _place(record["output"]),
        record.value,
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


def _check_output(record: Record) -> None:
    """What tells which image the sidecar belongs to; versions before had no size and digest."""
    if (name := record.get("file")) is not None and Path(name.text()).name != name.value:
        name.expected("the name of a file in the same folder")
    if (size := record.get("bytes")) is not None:
        size.integer(0)
    if (digest := record.get("sha256")) is not None:
        digest.text()


def _place(output: Record) -> Georeference | None:
    """Where the plane lies on the Earth; versions before did not say."""
    record = output.get("georeference")
    if record is None or (code := record.get("crs")) is None:
        return None
    prefix, _, number = code.text().partition(":")
    if prefix != "EPSG" or not number.isdecimal():
        code.expected("EPSG: and a number")
    try:
        crs = Crs(int(number))
    except ArgumentError as error:
        code.fail(str(error))
    (a, b, east), (_, _, north) = (row.numbers(3) for row in _two(record["pixel_to_map"]))
    from_plane = output["plane_to_output"].matrix()
    if not (a or b) or not np.any(from_plane[0, :2]):
        record["pixel_to_map"].expected("a similarity")
    off = [(item["name"].text(), item.get("off_m")) for item in record["rejected"].items()]
    place = Georeference(
        crs,
        complex(a, b),
        complex(east, north),
        record["rms_m"].number(),
        record["positions_used"].integer(0),
        record["positions"].integer(0),
        tuple((name, math.inf if away is None else away.number()) for name, away in off),
    )
    return place.after(np.linalg.inv(from_plane).astype(np.float64))


def _image(record: Record) -> SavedImage:
    name, path, used = record["name"].text(), record["path"].text(), record["used"].flag()
    camera = None
    if record.get("size") is not None:
        source = record.get("focal_source")
        camera = read_lens(record, record["size"].size(), None if source is None else source.choice(FOCAL_LOG_STD))
    if used and camera is None:
        record["size"].expected("width and height of an image that was used")
    to_plane = record["to_plane"].matrix() if used else None
    field = record.get("displacement")
    moved = None if field is None or not used or camera is None else _displacement(field, camera)
    return SavedImage(name, path, camera, to_plane, record["reason"].text(), moved)


def _displacement(record: Record, camera: Camera) -> DisplacementField:
    columns, rows = (item.integer(least=2) for item in _two(record["grid"]))
    nodes = [item.pair() for item in record["px"].items()]
    if len(nodes) != rows * columns:
        record["px"].expected(f"{rows * columns} displacements")
    return DisplacementField(camera.image_size, np.array(nodes, dtype=np.float64).reshape(rows, columns, 2))


def _two(record: Record) -> list[Record]:
    items = list(record.items())
    if len(items) != 2:
        record.expected("two numbers")
    return items


def _reference(record: Record, images: Sequence[SavedImage]) -> int:
    name = record.text()
    found = [index for index, image in enumerate(images) if image.name == name and image.to_plane is not None]
    if not found:
        record.fail(f"there is no used image {name!r}")
    return found[0]


def _composite_options(record: Record) -> CompositeOptions:
    """The compositing options; what this version does not know is refused, what it added has its default."""
    hints, known = get_type_hints(CompositeOptions), {option.name for option in fields(CompositeOptions)}
    given = {}
    for name, value in record.fields().items():
        if name not in known:
            value.fail("this rdstitch has no such option")
        given[name] = _option(value, hints[name])
    try:
        return CompositeOptions(**given)
    except ArgumentError as error:
        record.fail(str(error))


def _as_laid_out(options: CompositeOptions, record: Record) -> CompositeOptions:
    """The options with the projection that "auto" came to where the camera turned on the spot."""
    if options.projection != "auto" or record["model"].value != "rotation":
        return options
    chosen = record["output"]["projection"].choice(PROJECTIONS)
    return replace(options, projection=next(name for name in PROJECTIONS if name == chosen))


def _option(record: Record, hint: Any) -> Any:
    """A value of the type that an option has."""
    kinds = get_args(hint) or (hint,)
    if record.value is None and type(None) in kinds:
        return None
    if bool in kinds:
        return record.flag()
    if float in kinds:
        return record.number()
    return record.integer() if int in kinds else record.text()
