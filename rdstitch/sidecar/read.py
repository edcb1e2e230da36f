"""Reading a sidecar: its fields are checked, and make the registration that was saved."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.compositing import CompositeOptions
from rdstitch.errors import ArgumentError, InputError
from rdstitch.georeferencing.georeference import Georeference
from rdstitch.io.fingerprint import Fingerprint, fingerprint
from rdstitch.sidecar.image_record import ImageRecord
from rdstitch.sidecar.records import VERSION, SidecarRecord
from rdstitch.system.file_access import read_text
from rdstitch.system.output_checks import tiles_folder
from rdstitch.system.records import Matrix, convert, parse_json

_OF_A_MACHINE = ("max_memory", "workers")  # options that the machine that wrote a sidecar had, not the picture


def json_schema() -> dict[str, Any]:
    """The JSON Schema of sidecars of this version."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **msgspec.json.schema(SidecarRecord)}


@dataclass(frozen=True, eq=False)
class SavedRegistration:
    """A registration as its sidecar has it."""

    path: Path  # of the sidecar
    record: SidecarRecord
    composite: CompositeOptions  # what the image was composited with

    @property
    def images(self) -> Sequence[ImageRecord]:
        """All images, also those that are not in the output."""
        return self.record.images

    def original(self, image: ImageRecord) -> Path | None:
        """Its file, if it is still where the sidecar has it."""
        file = self.path.parent / image.path
        return file if file.is_file() else None

    @cached_property
    def reference(self) -> int:
        """The image whose resolution the output has."""
        return next(k for k, image in enumerate(self.images) if image.used and image.name == self.record.reference)

    @property
    def turned(self) -> bool:
        """Whether the camera turned on the spot, so that ``to_plane`` leads to directions."""
        return self.record.model == "rotation"

    @property
    def orientation(self) -> FloatArray | None:
        """What the registered images were turned by to be at ``to_plane``, (3, 3)."""
        return _array(self.record.output.orientation)

    @property
    def plane_to_output(self) -> FloatArray | None:
        """From the plane to pixels of the output, (3, 3)."""
        return _array(self.record.output.plane_to_output)

    @property
    def place(self) -> Georeference | None:
        """Of the plane, where the output was georeferenced."""
        place, to_output = self.record.output.place, self.plane_to_output
        return None if place is None or to_output is None else place.after(np.linalg.inv(to_output).astype(np.float64))


def _array(matrix: Matrix | None) -> FloatArray | None:
    return None if matrix is None else np.array(matrix, dtype=np.float64)


def read_sidecar(path: str | Path) -> SavedRegistration:
    """Read a sidecar; every field that is there is checked."""
    content, file = parse_json(read_text(path), str(path)), str(path)
    if isinstance(content, dict) and isinstance(version := content.get("version"), int) and version > VERSION:
        raise InputError(f"{path}: version: this rdstitch reads versions 1 to {VERSION} of sidecars, not {version}")
    record = convert(content, SidecarRecord, file)
    return SavedRegistration(Path(path), record, _composite_options(record, file))


def _composite_options(record: SidecarRecord, file: str) -> CompositeOptions:
    given = convert(record.options.get("composite"), dict[str, Any], file, "options.composite")
    given = {name: value for name, value in given.items() if name not in _OF_A_MACHINE}
    unknown = [name for name in given if name not in CompositeOptions.__dataclass_fields__]
    if unknown:
        raise InputError(f"{file}: options.composite.{unknown[0]}: this rdstitch has no such option")
    try:
        composite = CompositeOptions(**given)
    except ArgumentError as error:
        raise InputError(f"{file}: options.composite.{error}") from error
    if composite.projection == "auto" and record.model == "rotation":
        return replace(composite, projection=record.output.projection or "auto")
    return composite


def mismatch_with_image(saved: SavedRegistration) -> str:
    """Why the image beside a sidecar is not the one that it was written with; empty where it is, or is not there."""
    output = saved.record.output
    if output.sha256 is None or output.file is None or output.bytes is None:
        return ""
    image = saved.path.with_name(output.file)
    tiles = tiles_folder(image) if image.suffix.lower() == ".dzi" else None
    try:
        same = fingerprint(image, tiles) == Fingerprint(output.bytes, output.sha256)
    except OSError:
        return ""
    return "" if same else f"{image}: is not the image that {saved.path.name} was written with; one of them is newer"
