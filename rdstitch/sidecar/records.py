"""The fields of a sidecar with their types: what is written, what is read and checked, and the JSON Schema.

docs/formats.md describes the fields. Fields may be added, but options of compositing, without which a reader would draw
another picture: it refuses those that it does not know. A change that would mislead a reader raises the version. What
earlier versions did not have has a default.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, Any, Literal, Self, cast

import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType, field

from rdstitch.alignment.result import LinkFit
from rdstitch.choices import FocalSource
from rdstitch.geometry.camera_record import CameraRecord
from rdstitch.local_alignment import HeldOut, LocalAlignment
from rdstitch.matching.two_view import PairRegistration
from rdstitch.results.registration import Registration
from rdstitch.sidecar.image_record import ImageRecord
from rdstitch.sidecar.output_record import OutputRecord, SeamsRecord
from rdstitch.system.records import Count, Matrix, NonNegative, Pair, Positive

VERSION = 2  # version 1 had no more of a lens than λ and μ, as ``lambda`` and ``lambda2``

Lens = Literal["division", "division-center", "division2", "division3"]
Model = Literal["rigid", "similarity", "tilting", "pose", "homography", "rotation"]


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

    @classmethod
    def of(cls, local: LocalAlignment) -> Self:
        """The record of a local alignment."""
        return cls(bool(local.fields), local.reason, local.cells, BeforeAfter(local.before, local.after))


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

    @classmethod
    def of(cls, pair: PairRegistration, fit: LinkFit | None, names: Sequence[str]) -> Self:
        """The record of a pair, and how it fits the alignment; ``names`` are those of all images."""
        relation = pair.relation
        return cls(
            images=(names[pair.image1], names[pair.image2]),
            matches=len(pair.matches),
            inliers=int(relation.inliers.sum()),
            rms_px=relation.rms,
            lambda_=relation.distortion,
            lambda_std=relation.distortion_std if relation.ok else None,
            model=cast(Model | None, relation.model or None),
            homography=relation.homography.tolist() if relation.ok else None,
            solver=relation.solver or None,
            iterations=relation.iterations,
            ok=relation.ok,
            reason=relation.reason,
            used=fit is not None and fit.used,
            dropped="" if fit is None else fit.reason,
            inliers_of_whole=None if fit is None else fit.inliers,
            rms_of_whole_px=None if fit is None else fit.rms,
        )


class ReliefRecord(Struct):
    """Whether the scene is the plane that it is taken for."""

    found: bool
    coherence: float | None
    size: float | None
    explanation: str


class VerdictRecord(Struct):
    """Whether the result can be relied on."""

    ok: bool
    failures: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    relief: ReliefRecord | None = None

    @classmethod
    def of(cls, registration: Registration) -> Self:
        """The record of the verdict on a registration."""
        verdict, relief = registration.verdict, ReliefRecord(**asdict(registration.alignment.relief))
        return cls(verdict.ok, verdict.failures, verdict.warnings, relief)


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
    pixel_um: Positive | None
    z: int | Literal["max"] | None = None
    time: int | None = None
    matrix: tuple[Pair, Pair]
    rows_px: list[Pair]
    columns_px: list[Pair]
    row_std_px: NonNegative | None
    column_std_px: NonNegative | None
    tile_std_px: NonNegative
    tiles: list[TileRecord]

    @classmethod
    def of(cls, registration: Registration) -> Self | None:
        """The record of the stage of a registration; None where the images are no tiles."""
        if registration.tiles is None:
            return None
        grid, model = registration.tiles.grid, registration.tiles.adjustment.stage
        # Whole pixels are another source of error.
        rounding = 0.0 if registration.alignment.distortion else math.sqrt(1.0 / 12.0)
        stds = np.hypot(registration.tiles.stds, rounding).tolist()
        tiles = zip(registration.sources, grid.rows, grid.columns, registration.tiles.linked, stds, strict=True)
        return cls(
            source=grid.source,
            pixel_um=grid.pixel_size,
            z=registration.tiles.z,
            time=registration.tiles.time,
            matrix=model.matrix.tolist(),
            rows_px=model.rows.tolist(),
            columns_px=model.columns.tolist(),
            row_std_px=model.row_std,
            column_std_px=model.column_std,
            tile_std_px=model.std,
            tiles=[
                TileRecord(source.name, int(row), int(column), "overlap" if linked else "stage", std)
                for source, row, column, linked, std in tiles
            ],
        )


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
