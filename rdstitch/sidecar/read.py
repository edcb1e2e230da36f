"""Reading a sidecar: its fields with their types, by which they are checked, and the registration that they make.

docs/formats.md describes the fields. Fields may be added; a change that would mislead a reader raises the version. What
earlier versions did not have has a default.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct, field

from rdstitch.arrays import FloatArray
from rdstitch.choices import ProjectionName
from rdstitch.compositing import CompositeOptions
from rdstitch.errors import ArgumentError, InputError
from rdstitch.export.georeference import Georeference, Residual
from rdstitch.geometry.camera import Camera, CameraRecord, FocalSource, LensRecord
from rdstitch.geometry.crs import Crs
from rdstitch.local_alignment import DisplacementField
from rdstitch.sidecar.write import VERSION
from rdstitch.system.file_access import read_text
from rdstitch.system.outputs import Fingerprint, fingerprint, tiles_folder
from rdstitch.system.records import (
    Count,
    Matrix,
    NonNegative,
    Pair,
    Size,
    Triple,
    check_invertible,
    convert,
    parse_json,
)

Lens = Literal["division", "division-center", "division2", "division3"]
Model = Literal["rigid", "similarity", "tilting", "pose", "homography", "rotation"]
_Row = tuple[float, float, float, float]
_Positive = Annotated[float, Meta(gt=0.0)]
_FileName = Annotated[str, Meta(pattern=r"^[^/\\]+$", description="in the folder of the sidecar")]
_Digest = Annotated[
    str,
    Meta(description="SHA-256 of the file; of a Deep Zoom image that of the list of its files, as sha256sum has it"),
]


class ResidualRecord(Struct):
    """How far east and north of a position, of an image or a control point, the output has it."""

    name: str
    east_m: float | None
    north_m: float | None
    used: bool


class GeoreferenceRecord(Struct, kw_only=True):
    """Where the output lies on the Earth; or only the reason why that is not known."""

    reason: str | None = None
    crs: Annotated[str, Meta(pattern="^EPSG:[0-9]+$")] | None = None
    gsd_m: _Positive | None = None
    pixel_to_map: tuple[Triple, Triple] | None = None
    north_up: bool | None = None
    source: Literal["GPS positions", "ground control points"] = "GPS positions"
    positions: Count = 0
    positions_used: Count = 0
    rms_m: NonNegative = 0.0
    std_m: NonNegative | None = None
    residuals: list[ResidualRecord] = []
    check_points: list[ResidualRecord] = []

    def __post_init__(self) -> None:
        if self.crs is not None and (self.pixel_to_map is None or not any(self.pixel_to_map[0][:2])):
            raise ValueError("expected a similarity as pixel_to_map")


class OutputRecord(Struct, kw_only=True):
    """The image that the sidecar belongs to."""

    file: _FileName | None = None
    bytes: Count | None = None
    sha256: _Digest | None = None
    size: Size | None = None
    plane_to_output: Matrix | None = None
    projection: ProjectionName | None = None
    orientation: Matrix | None = None
    wraps_around: bool = False
    field_of_view_deg: Pair | None = None
    center_deg: Pair | None = None
    georeference: GeoreferenceRecord | None = None

    def __post_init__(self) -> None:
        if self.plane_to_output is not None:
            check_invertible(self.plane_to_output, "plane_to_output")
        if self.orientation is not None:
            check_invertible(self.orientation, "orientation")


class HeldOut(Struct):
    """Residuals of matches that took no part in the fit, px."""

    median: NonNegative
    percentile95: NonNegative


class BeforeAfter(Struct):
    """The same without and with local alignment."""

    before: HeldOut | None
    after: HeldOut | None


class LocalAlignmentRecord(Struct):
    """What local alignment found; the displacements are with the images."""

    used: bool
    reason: str
    cells: Annotated[int, Meta(ge=0, description="of the grid, along the longer side of an image")]
    held_out_px: BeforeAfter


class BreakRecord(Struct):
    """Where a seam is broken, px of the output."""

    images: tuple[str, str]
    x: float
    y: float
    length_px: NonNegative
    shift_px: NonNegative | None


class SeamsRecord(Struct):
    """Where seams can be judged, and where they are broken."""

    places: Count
    broken: Count
    breaks: list[BreakRecord]


class Displacement(Struct):
    """What local alignment adds to the pixels of an image, on a grid from its first to its last pixel."""

    grid: Annotated[tuple[Annotated[int, Meta(ge=2)], Annotated[int, Meta(ge=2)]], Meta(description="columns and rows")]
    px: Annotated[list[Pair], Meta(description="x and y at every node, row by row")]

    def __post_init__(self) -> None:
        if len(self.px) != self.grid[0] * self.grid[1]:
            raise ValueError(f"expected {self.grid[0] * self.grid[1]} displacements, not {len(self.px)}")


class PoseRecord(Struct):
    """Where the camera was, in heights of the reference image."""

    x: float
    y: float
    height: _Positive
    yaw_deg: float
    tilt_deg: Pair
    covariance: Annotated[
        tuple[_Row, _Row, _Row, _Row] | None, Meta(description="of x, y, height and yaw, heights and radians")
    ] = None


class ImageRecord(LensRecord, kw_only=True):
    """One image; one that could not be read has no size."""

    name: str
    path: str
    size: Size | None
    used: bool
    reason: str
    features: Count | None = None
    to_plane: Matrix | None = None
    to_output: Matrix | None = None
    displacement: Displacement | None = None
    pose: PoseRecord | None = None
    timestamp: Annotated[float, Meta(description="s since 1970, by EXIF")] | None = None
    gps: (
        Annotated[
            tuple[float, float, float | None], Meta(description="latitude and longitude, degrees; altitude, m, or null")
        ]
        | None
    ) = None

    def __post_init__(self) -> None:
        if self.size is not None:
            self.lens(self.size)
        if self.used and (self.size is None or self.to_plane is None):
            raise ValueError(f"is used, and needs {'size' if self.size is None else 'to_plane'}")
        if self.to_plane is not None:
            check_invertible(self.to_plane, "to_plane")
        if not self.used:
            self.to_plane = None

    @property
    def camera(self) -> Camera | None:
        """With everything that was estimated; None where the image could not be read."""
        return None if self.size is None else self.lens(self.size)

    def displacement_field(self) -> DisplacementField | None:
        """Give what local alignment found; None where the image was not aligned locally."""
        if self.displacement is None or self.size is None or not self.used:
            return None
        columns, rows = self.displacement.grid
        return DisplacementField(self.size, np.array(self.displacement.px, dtype=np.float64).reshape(rows, columns, 2))


class PairRecord(Struct, kw_only=True):
    """One pair of images that was looked at."""

    images: tuple[str, str]
    matches: Count
    inliers: Count
    rms_px: float | None
    lambda_: float | None = field(name="lambda")
    lambda_std: float | None
    model: Model | None
    homography: Matrix | None
    solver: str | None
    iterations: Count
    ok: bool
    reason: str
    used: bool
    dropped: str
    inliers_of_whole: Count | None
    rms_of_whole_px: float | None


class ReliefRecord(Struct):
    """Whether the scene is the plane that it is taken for."""

    found: bool
    coherence: float | None
    size: float | None
    explanation: str


class VerdictRecord(Struct):
    """Whether the result can be relied on."""

    ok: bool
    failures: list[str] = []
    warnings: list[str] = []
    relief: ReliefRecord | None = None


class OptionsRecord(Struct):
    """What the image was made with; those of compositing are read by their own rules."""

    composite: dict[str, Any]


class TileRecord(Struct):
    """Where a tile on a stage is in its row and column, and what placed it."""

    name: str
    row: Count
    column: Count
    placed_by: Literal["overlap", "stage"]
    std_px: NonNegative = 0.0


class StageRecord(Struct, kw_only=True):
    """What a stage does: the matrix from its pixels to the camera's, and what its lines are off, px."""

    source: str
    pixel_um: _Positive | None
    z: int | Literal["max"] | None = None
    time: int | None = None
    matrix: tuple[Pair, Pair]
    rows_px: list[Pair]
    columns_px: list[Pair]
    row_std_px: NonNegative | None
    column_std_px: NonNegative | None
    tile_std_px: NonNegative
    tiles: list[TileRecord]


class Applied(Struct):
    """Only in the sidecar of ``apply``: what was applied, and how images found their places."""

    sidecar: str
    matched: Literal["name", "time", "position", "order"]


class SidecarRecord(Struct, kw_only=True):
    """What ``rdstitch pano``, ``mosaic`` and ``apply`` write beside an image."""

    format: Literal["rdstitch sidecar"]
    version: Annotated[int, Meta(ge=1, le=VERSION)]
    lambda_: Annotated[float, Meta(description="of the division model for half the image diagonal")] = field(
        name="lambda"
    )
    lambda_std: Annotated[float, Meta(ge=0.0, description="0 where λ was given, null where it cannot be seen")] | None
    lambda_px: float
    lambda_focal: float | None
    lambda_known: bool
    lens: Lens | None = None
    lens_reason: str = ""
    camera: CameraRecord
    tilt_deg: Pair | None
    focal_px: float | None
    focal_source: FocalSource | None
    model: Model
    model_reason: str
    rms_px: NonNegative | None
    reference: str
    output: OutputRecord
    local_alignment: LocalAlignmentRecord | None = None
    seams: SeamsRecord | None = None
    stage: StageRecord | None = None
    images: Annotated[list[ImageRecord], Meta(min_length=1)]
    pairs: list[PairRecord]
    verdict: VerdictRecord
    options: OptionsRecord
    seed: Count
    versions: dict[str, str]
    applied: Applied | None = None

    def __post_init__(self) -> None:
        if not any(image.name == self.reference and image.used for image in self.images):
            raise ValueError(f"reference: there is no used image {self.reference!r}")


def json_schema() -> dict[str, Any]:
    """The JSON Schema of sidecars of this version."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **msgspec.json.schema(SidecarRecord)}


@dataclass(frozen=True)
class SavedRegistration:
    """A registration as its sidecar has it."""

    path: Path  # of the sidecar
    record: SidecarRecord
    reference: int  # the image whose resolution the output has
    composite: CompositeOptions  # what the image was composited with
    output_place: Georeference | None  # of the output's pixels, where that was georeferenced
    content: dict[str, Any]  # the whole sidecar, with fields that this version does not have

    @property
    def images(self) -> list[ImageRecord]:
        """Those of the registration, used or not."""
        return self.record.images

    @property
    def turned(self) -> bool:
        """Whether the camera turned on the spot, so that ``to_plane`` leads to directions."""
        return self.record.model == "rotation"

    @property
    def orientation(self) -> FloatArray | None:
        """What the registered images were turned by to be at ``to_plane``, (3, 3); None where they were not."""
        matrix = self.record.output.orientation
        return None if matrix is None else np.array(matrix, dtype=np.float64)

    @property
    def place(self) -> Georeference | None:
        """Of the plane, where the output was georeferenced."""
        if self.output_place is None:
            return None
        matrix = np.array(self.record.output.plane_to_output, dtype=np.float64)
        return self.output_place.after(np.linalg.inv(matrix).astype(np.float64))


def read_sidecar(path: str | Path) -> SavedRegistration:
    """Read a sidecar; every field that is there is checked."""
    content = parse_json(read_text(path), str(path))
    if isinstance(content, dict) and isinstance(version := content.get("version"), int) and version > VERSION:
        raise InputError(f"{path}: version: this rdstitch reads versions 1 to {VERSION} of sidecars, not {version}")
    record = convert(content, SidecarRecord, str(path))
    unknown = [name for name in record.options.composite if name not in CompositeOptions.__dataclass_fields__]
    if unknown:
        raise InputError(f"{path}: options.composite.{unknown[0]}: this rdstitch has no such option")
    try:
        composite = CompositeOptions(**record.options.composite)
    except ArgumentError as error:
        raise InputError(f"{path}: options.composite.{error}") from error
    if composite.projection == "auto" and record.model == "rotation":
        composite = replace(composite, projection=record.output.projection or "auto")
    reference = next(k for k, image in enumerate(record.images) if image.name == record.reference and image.used)
    try:
        place = _place(record.output)
    except ArgumentError as error:
        raise InputError(f"{path}: output.georeference.crs: {error}") from error
    return SavedRegistration(Path(path), record, reference, composite, place, content)


def mismatch_with_image(saved: SavedRegistration) -> str:
    """Why the image beside a sidecar is not the one that it was written with; empty where it is, or is not there."""
    output = saved.record.output
    if output.sha256 is None or output.bytes is None or output.file is None:
        return ""
    image = saved.path.with_name(output.file)
    tiles = tiles_folder(image) if image.suffix.lower() == ".dzi" else None
    try:
        same = fingerprint(image, tiles) == Fingerprint(output.bytes, output.sha256)
    except OSError:
        return ""
    return "" if same else f"{image}: is not the image that {saved.path.name} was written with; one of them is newer"


def _place(output: OutputRecord) -> Georeference | None:
    """Give where the output lies on the Earth; versions before did not say."""
    record = output.georeference
    if record is None or record.crs is None or record.pixel_to_map is None or output.plane_to_output is None:
        return None
    (a, b, east), (_, _, north) = record.pixel_to_map
    return Georeference(
        Crs(int(record.crs.removeprefix("EPSG:"))),
        complex(a, b),
        complex(east, north),
        record.rms_m,
        record.source,
        _residuals(record.residuals),
        record.std_m,
        math.hypot(a, b) / (record.gsd_m or math.hypot(a, b)),
        checks=_residuals(record.check_points),
    )


def _residuals(records: Sequence[ResidualRecord]) -> tuple[Residual, ...]:
    return tuple(
        Residual(
            item.name,
            math.inf if item.east_m is None else item.east_m,
            math.inf if item.north_m is None else item.north_m,
            item.used,
        )
        for item in records
    )
