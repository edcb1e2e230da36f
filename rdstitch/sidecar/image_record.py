"""What a sidecar says of each image: its camera, where it belongs, and what local alignment moves in it."""

from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from msgspec import Meta, Struct

from rdstitch.alignment.result import PlanarPoses
from rdstitch.compositing.projection import PLANE
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.camera_record import LensRecord, lens_fields
from rdstitch.inputs.source import Source
from rdstitch.local_alignment import DisplacementField
from rdstitch.results.stitch_result import OutputImage
from rdstitch.sidecar.paths import recorded_path
from rdstitch.system.records import Count, Matrix, Pair, Positive, Size, check_invertible

_Row = tuple[float, float, float, float]


class Displacement(Struct):
    """What local alignment adds to the pixels of an image, on a grid from its first to its last pixel."""

    grid: Annotated[tuple[Annotated[int, Meta(ge=2)], Annotated[int, Meta(ge=2)]], Meta(description="columns and rows")]
    px: Annotated[list[Pair], Meta(description="x and y at every node, row by row")]

    def __post_init__(self) -> None:
        if len(self.px) != self.grid[0] * self.grid[1]:
            raise ValueError(f"expected {self.grid[0] * self.grid[1]} displacements, not {len(self.px)}")

    @classmethod
    def of(cls, field: DisplacementField | None) -> Self | None:
        """The record of a field; None where the image was not aligned locally."""
        if field is None:
            return None
        rows, columns, _ = field.values.shape
        return cls((columns, rows), [(x, y) for x, y in field.values.reshape(-1, 2).tolist()])


class PoseRecord(Struct):
    """Where the camera was, in heights of the reference image."""

    x: float
    y: float
    height: Positive
    yaw_deg: float
    tilt_deg: Pair
    covariance: Annotated[
        tuple[_Row, _Row, _Row, _Row] | None, Meta(description="of x, y, height and yaw, heights and radians")
    ] = None

    @classmethod
    def of(cls, poses: PlanarPoses, image: int) -> Self:
        """The record of the pose of an image."""
        x, y = poses.position[image].tolist()
        return cls(
            x,
            y,
            float(poses.height[image]),
            float(np.degrees(poses.yaw[image])),
            np.degrees(poses.tilt[image]).tolist(),
            None if poses.covariance is None else poses.covariance[image].tolist(),
        )


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

    @property
    def displacement_field(self) -> DisplacementField | None:
        """What local alignment found; None where the image was not aligned locally."""
        if self.displacement is None or self.size is None or not self.used:
            return None
        columns, rows = self.displacement.grid
        return DisplacementField(self.size, np.array(self.displacement.px, dtype=np.float64).reshape(rows, columns, 2))


def image_fields(source: Source, camera: Camera, output: Path | None) -> dict[str, Any]:
    """The fields of the record of any image: its file, its camera, when and where it was taken."""
    gps = source.metadata.gps
    return {
        "name": source.name,
        "path": recorded_path(source.path, output),
        "size": camera.image_size,
        "timestamp": source.metadata.timestamp,
        "gps": None if gps is None else (gps.latitude, gps.longitude, gps.altitude),
        **lens_fields(camera),
    }


def placement_fields(output: OutputImage, k: int) -> dict[str, Any]:
    """The fields of the record of the k-th image of an output that say where it belongs."""
    canvas, placed = output.canvas, output.placed
    homography = placed.homographies[k]
    return {
        "to_plane": homography.tolist(),
        # One matrix can say it on a plane only.
        "to_output": (canvas.matrix @ homography).tolist() if canvas.projection == PLANE else None,
        "displacement": None if placed.displacements is None else Displacement.of(placed.displacements[k]),
    }
