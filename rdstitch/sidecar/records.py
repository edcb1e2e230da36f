"""The fields of a sidecar with their types: what is written, what is read and checked, and the JSON Schema.

docs/formats.md describes the fields. Fields may be added, but options of compositing, without which a reader would draw
another picture: it refuses those that it does not know. A change that would mislead a reader raises the version. What
earlier versions did not have has a default.
"""

from typing import Annotated, Any, Literal

import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType, field

from rdstitch.choices import FocalSource, ProjectionName
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.camera_record import CameraRecord, LensRecord
from rdstitch.local_alignment import DisplacementField, HeldOut
from rdstitch.system.records import Count, Matrix, NonNegative, Pair, Size, Triple, check_invertible

VERSION = 2  # version 1 had no more of a lens than λ and μ, as ``lambda`` and ``lambda2``

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
    source: Literal["GPS positions", "ground control points"] | None = None
    positions: Count = 0
    positions_used: Count = 0
    rms_m: NonNegative | None = None
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


class BeforeAfter(Struct):
    """Residuals of matches that took no part in the fit, without and with local alignment."""

    before: HeldOut | None
    after: HeldOut | None


class LocalAlignmentRecord(Struct):
    """What local alignment found; the displacements are with the images."""

    used: bool
    reason: str
    cells: Annotated[int, Meta(ge=0, description="of the grid, along the longer side of an image")]
    held_out_px: BeforeAfter


class Displacement(Struct):
    """What local alignment adds to the pixels of an image, on a grid from its first to its last pixel."""

    grid: Annotated[tuple[Annotated[int, Meta(ge=2)], Annotated[int, Meta(ge=2)]], Meta(description="columns and rows")]
    px: Annotated[list[Pair], Meta(description="x and y at every node, row by row")]

    def __post_init__(self) -> None:
        if len(self.px) != self.grid[0] * self.grid[1]:
            raise ValueError(f"expected {self.grid[0] * self.grid[1]} displacements, not {len(self.px)}")


class BreakRecord(Struct):
    """A stretch of a seam whose two sides do not fit, px of the output."""

    images: tuple[str, str]
    x: float
    y: float
    length_px: NonNegative
    shift_px: NonNegative | None


class SeamsRecord(Struct):
    """How many places along the seams have texture on both sides, how many are broken, and where."""

    places: Count
    broken: Count
    breaks: list[BreakRecord]


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


class ImageRecord(LensRecord):
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
        """What local alignment found; None where the image was not aligned locally."""
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


# How given images found the registered ones whose places they take.
MatchedBy = Literal["name", "time", "position", "order"]


class Applied(Struct):
    """Only in the sidecar of ``apply``: what was applied, and how images found their places."""

    sidecar: str
    matched: MatchedBy


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
    options: Annotated[dict[str, Any], Meta(description="what the image was made with; at least `composite`")]
    seed: Count
    versions: dict[str, str]
    applied: Applied | UnsetType = UNSET

    def __post_init__(self) -> None:
        if not any(image.name == self.reference and image.used for image in self.images):
            raise ValueError(f"reference: there is no used image {self.reference!r}")
