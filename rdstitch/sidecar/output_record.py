"""What a sidecar says of the output: its file, its frame, its place on the Earth and its seams."""

import math
from typing import Annotated, Self

import numpy as np
from msgspec import Meta, Struct

from rdstitch.choices import ProjectionName
from rdstitch.compositing.panorama_canvas import center_of_view, field_of_view
from rdstitch.geometry.crs import Crs
from rdstitch.georeferencing.georeference import Georeference, PositionKind, Residual
from rdstitch.results.stitch_result import OutputImage
from rdstitch.system.records import Count, Matrix, NonNegative, Pair, Positive, Size, Triple, check_invertible

_FileName = Annotated[str, Meta(pattern=r"^[^/\\]+$", description="in the folder of the sidecar")]
_Digest = Annotated[
    str,
    Meta(description="SHA-256 of the file; of a Deep Zoom image that of the list of its files, as sha256sum has it"),
]


class GeoreferenceRecord(Struct, kw_only=True):
    """Where the output lies on the Earth; or only the reason why that is not known."""

    reason: str | None = None
    crs: Annotated[str, Meta(pattern="^EPSG:[0-9]+$")] | None = None
    gsd_m: Positive | None = None
    pixel_to_map: tuple[Triple, Triple] | None = None
    north_up: bool | None = None
    source: PositionKind | None = None
    positions: Count = 0
    positions_used: Count = 0
    rms_m: NonNegative | None = None
    std_m: NonNegative | None = None
    residuals: tuple[Residual, ...] = ()
    check_points: tuple[Residual, ...] = ()

    def __post_init__(self) -> None:
        if self.crs is not None and (self.pixel_to_map is None or not any(self.pixel_to_map[0][:2])):
            raise ValueError("expected a similarity as pixel_to_map")
        self.georeference()  # refuses a coordinate system that is not known

    @classmethod
    def of(cls, place: Georeference) -> Self:
        """The record of a georeference."""
        return cls(
            crs=f"EPSG:{place.crs.epsg}",
            gsd_m=place.gsd,
            pixel_to_map=place.pixel_to_map.tolist(),
            north_up=place.north_up,
            source=place.source,
            positions=len(place.residuals),
            positions_used=place.used,
            rms_m=place.rms,
            std_m=place.std,
            residuals=place.residuals,
            check_points=place.checks,
        )

    def georeference(self) -> Georeference | None:
        """The georeference that it describes."""
        if self.crs is None or self.pixel_to_map is None:
            return None
        (a, b, east), (_, _, north) = self.pixel_to_map
        return Georeference(
            Crs(int(self.crs.removeprefix("EPSG:"))),
            complex(a, b),
            complex(east, north),
            self.rms_m,
            self.source or PositionKind.GPS,
            self.residuals,
            self.std_m,
            math.hypot(a, b) / (self.gsd_m or math.hypot(a, b)),
            checks=self.check_points,
        )


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

    @property
    def place(self) -> Georeference | None:
        """Where the output lies on the Earth; earlier versions did not say."""
        return None if self.georeference is None or self.plane_to_output is None else self.georeference.georeference()

    @classmethod
    def of(cls, output: OutputImage) -> Self:
        """The record of an output: by size and digest a reader sees whether the sidecar still belongs to it."""
        canvas, written, place = output.canvas, output.fingerprint, output.georeference
        turned = output.placed.turned
        return cls(
            file=None if output.output is None else output.output.name,
            bytes=None if written is None else written.size,
            sha256=None if written is None else written.sha256,
            size=canvas.size,
            plane_to_output=canvas.matrix.tolist(),
            projection=canvas.projection.name,
            orientation=None if canvas.orientation is None else canvas.orientation.tolist(),
            wraps_around=canvas.period is not None,
            field_of_view_deg=np.degrees(field_of_view(canvas)).tolist() if turned else None,
            center_deg=np.degrees(center_of_view(canvas)).tolist() if turned else None,
            georeference=(
                GeoreferenceRecord(reason=output.not_georeferenced) if place is None else GeoreferenceRecord.of(place)
            ),
        )


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

    @classmethod
    def of(cls, output: OutputImage) -> Self:
        """The record of the seams of an output."""
        seams, names = output.seams, [source.name for source in output.placed.sources]
        breaks = [
            BreakRecord((names[each.images[0]], names[each.images[1]]), *each.position, each.length, each.size)
            for each in seams.breaks
        ]
        return cls(len(seams.places), int(seams.broken.sum()), breaks)
