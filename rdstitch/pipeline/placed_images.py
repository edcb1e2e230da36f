"""Registered pictures, ready to be composited, and the canvas that they need."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Self

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing import Canvas, CompositeOptions, plan_canvas, plan_panorama
from rdstitch.compositing.near_part import NearPart
from rdstitch.compositing.placed_picture import Displacement, PlacedPicture, place_pictures
from rdstitch.errors import ArgumentError
from rdstitch.inputs.source import Source, readers
from rdstitch.io.metadata import GpsPosition
from rdstitch.io.read import Picture
from rdstitch.registration import Registration


@dataclass(frozen=True)
class PlacedImages:
    """The pictures that are used, and where they belong.

    Attributes
    ----------
    sources : sequence of Source
    cameras : sequence of Camera
    homographies : ndarray of shape (N, 3, 3)
        Normalized undistorted coordinates of each picture to the plane, or to directions.
    reference : int or None
        Picture whose resolution the output has; None for the median one's.
    displacements : sequence of callables or None, optional
        What local alignment adds to the measured pixels of each picture.
    turned : bool
        Whether the camera turned on the spot, so that the homographies lead to directions, not to a plane.
    """

    sources: Sequence[Source]
    cameras: Sequence[Camera]
    homographies: FloatArray
    reference: int | None
    displacements: Sequence[Displacement | None] | None = None
    turned: bool = False

    @classmethod
    def of(cls, registration: Registration, displacements: Sequence[Displacement | None] | None) -> Self:
        """Those that a registration uses."""
        alignment = registration.alignment
        used = np.flatnonzero(alignment.used)
        return cls(
            [registration.sources[i] for i in used],
            [alignment.cameras[i] for i in used],
            alignment.homographies[used],
            int(np.flatnonzero(used == alignment.reference)[0]),
            displacements,
            alignment.on_sphere,
        )

    @property
    def positions(self) -> list[GpsPosition | None]:
        """Where each picture was taken; a camera that turned on the spot was at one place, and shows no plane."""
        return [None if self.turned else source.metadata.gps for source in self.sources]

    def pictures(self, near: Sequence[NearPart | None]) -> list[PlacedPicture]:
        """As the compositor takes them, with only the near parts of those that are not drawn whole."""
        read = [
            reader if part is None else partial(_read_near, reader, part)
            for reader, part in zip(readers(self.sources), near or [None] * len(self.sources), strict=True)
        ]
        exposure = [source.metadata.exposure for source in self.sources]
        moved = self.displacements or None
        return place_pictures(
            read, self.cameras, self.homographies, preview=read, exposure=exposure, displacement=moved
        )


def _read_near(read: Callable[..., Picture], part: NearPart, reduction: int = 1) -> Picture:
    """A picture, whole or reduced, of which only its near part is drawn."""
    return part.masked(read(reduction))


def plan(placed: PlacedImages, options: CompositeOptions) -> Canvas:
    """The canvas of the pictures, no larger than ``options.max_size``."""
    canvas = _plan(placed, options, options.scale)
    if options.max_size is None or max(canvas.size) <= options.max_size:
        return canvas
    # The canvas has whole pixels around the pictures, and a full turn a multiple of some: these may be too many.
    spare = 1 if canvas.period is None else max(32, options.max_size // 128)
    return _plan(placed, options, options.scale * (options.max_size - spare) / max(canvas.size))


def _plan(placed: PlacedImages, options: CompositeOptions, scale: float) -> Canvas:
    """The canvas on a plane, or, of pictures taken by turning on the spot, in a projection."""
    names = [source.name for source in placed.sources]
    if placed.turned:
        return plan_panorama(
            placed.cameras,
            placed.homographies,
            projection=options.projection,
            scale=scale,
            rotate=options.rotate,
            reference=placed.reference,
            names=names,
            max_stretch=options.max_stretch,
        )
    if options.projection not in ("auto", "plane"):
        raise ArgumentError(
            f"the {options.projection} projection is for pictures taken by turning on the spot; these were not, "
            "leave out --projection"
        )
    return plan_canvas(
        placed.cameras,
        placed.homographies,
        scale=scale,
        rotate=options.rotate,
        reference=placed.reference,
        names=names,
        max_stretch=options.max_stretch,
    )
