"""Registered images, ready to be composited: aligned locally, without what is static."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.compositing import Canvas
from rdstitch.compositing.source_images import Displacement, PlacedImage
from rdstitch.compositing.static_pixels import MIN_IMAGES, static_pixels
from rdstitch.compositing.visible_region import VisibleRegion
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.places import GpsPosition
from rdstitch.georeferencing.georeference import Georeference
from rdstitch.georeferencing.place_on_map import Located, has_place
from rdstitch.inputs.source import Source
from rdstitch.io.radiometric_tags import Radiometry
from rdstitch.io.read import DecodedImage
from rdstitch.io.reduction import fitting_reduction
from rdstitch.results.registration import Registration

# Images, and pixels of their longer side, that are compared to find what is static in them.
_STATIC_SAMPLE, _STATIC_SIDE = 8, 400


@dataclass(frozen=True, eq=False)
class SavedGrid:
    """The pixels of an output of an earlier run."""

    from_plane: FloatArray  # (3, 3)
    size: tuple[int, int]
    place: Georeference | None


@dataclass(frozen=True, eq=False)
class PlacedImages:
    """The images that are used, and where they belong."""

    sources: Sequence[Source]
    cameras: Sequence[Camera]
    # (N, 3, 3): normalized undistorted coordinates of each image to the plane, or to directions
    homographies: FloatArray
    reference: int | None  # image whose resolution the output has; None for the median one's
    # what local alignment adds to the measured pixels of each image
    displacements: Sequence[Displacement | None] | None = None
    # whether the camera turned on the spot, so that the homographies lead to directions, not to a plane
    turned: bool = False
    place: Georeference | None = None  # of the plane, where it is known from an earlier run
    whole: bool = False  # whether nothing of them can be static: tiles on a stage, whose ground may be black
    # (3, 3): what the homographies were turned by; see :mod:`rdstitch.pipeline.straighten`
    orientation: FloatArray | None = None
    relief: float = 0.0  # pixels that neighbours are off together, where the ground is no plane
    lever_std: float = 0.0  # see Located
    leverage: Mapping[int | str, float] = field(default_factory=dict)  # see Located
    grid: SavedGrid | None = None  # pixels that the output is made on

    @classmethod
    def of(cls, registration: Registration, displacements: Sequence[Displacement | None] | None) -> Self:
        """Those that a registration uses."""
        alignment = registration.alignment
        used = np.flatnonzero(alignment.used)
        return cls(
            [replace(registration.sources[i], camera=alignment.cameras[i]) for i in used],
            [alignment.cameras[i] for i in used],
            alignment.homographies[used],
            int(np.flatnonzero(used == alignment.reference)[0]),
            displacements,
            alignment.on_sphere,
            whole=registration.tiles is not None,
            relief=alignment.relief.size if alignment.relief.found else 0.0,
            lever_std=alignment.lever_std,
            leverage={**alignment.leverage, **{k: alignment.leverage.get(int(i), 0.0) for k, i in enumerate(used)}},
        )

    @cached_property
    def static(self) -> NDArray[np.bool_] | None:
        """What shows the camera's parts, or nothing, in a few images of the commonest size; None where none does."""
        size, count = Counter(camera.image_size for camera in self.cameras).most_common(1)[0]
        if self.whole or count < MIN_IMAGES:
            return None
        alike = [s for s, camera in zip(self.sources, self.cameras, strict=True) if camera.image_size == size]
        chosen = evenly_spaced(count, _STATIC_SAMPLE).tolist()
        reduction = fitting_reduction(max(size) / _STATIC_SIDE)
        return static_pixels([alike[k].read(reduction, keep=True).pixels for k in chosen])

    @property
    def positions(self) -> list[GpsPosition | None]:
        """Where each image was taken; a camera that turned on the spot was at one place, and shows no plane."""
        return [None if self.turned else source.metadata.gps for source in self.sources]

    @property
    def has_place(self) -> bool:
        """Whether enough is known for a place of the output on the Earth to be expected."""
        return not self.turned and has_place(self.sources)

    def located(self, canvas: Canvas) -> Located:
        """The images on a canvas with what is known of where they are."""
        return Located(
            self.positions,
            self.cameras,
            canvas.matrix @ self.homographies,
            [source.name for source in self.sources],
            [source.metadata.nadir for source in self.sources],
            [source.control for source in self.sources],
            self.relief,
            self.lever_std,
            self.leverage,
        )

    def images(self, canvas: Canvas) -> list[PlacedImage]:
        """As the compositor takes them, with only the near parts of those that a canvas does not show whole."""
        read: list[Callable[..., DecodedImage]] = [
            source.read if part is None else partial(_read_near, source.read, part)
            for source, part in zip(self.sources, canvas.near, strict=True)
        ]
        if self.static is not None:
            common = Counter(camera.image_size for camera in self.cameras).most_common(1)[0][0]
            read = [
                partial(_read_moving, reader, self.static) if camera.image_size == common else reader
                for reader, camera in zip(read, self.cameras, strict=True)
            ]
        located, displacements = self.place is not None, self.displacements or [None] * len(self.sources)
        images = zip(read, self.cameras, self.homographies, self.sources, displacements, strict=True)
        return [
            PlacedImage(
                reader,
                camera,
                matrix,
                source.metadata.exposure,
                displacement,
                str(source.path),
                source.metadata.radiometry or (Radiometry() if located or source.metadata.gps else None),
                source.metadata.channels in (3, 4),
                source.may_be_transparent or self.static is not None,
            )
            for reader, camera, matrix, source, displacement in images
        ]


def _read_moving(read: Callable[..., DecodedImage], static: NDArray[np.bool_], reduction: int = 1) -> DecodedImage:
    """An image, whole or reduced, without what is static."""
    image = read(reduction)
    height, width = image.pixels.shape[:2]
    rows, columns = np.arange(height) * static.shape[0] // height, np.arange(width) * static.shape[1] // width
    alpha = np.full((height, width), 255, dtype=np.uint8) if image.alpha is None else image.alpha
    return replace(image, alpha=np.where(static[np.ix_(rows, columns)], np.uint8(0), alpha))


def _read_near(read: Callable[..., DecodedImage], part: VisibleRegion, reduction: int = 1) -> DecodedImage:
    """An image, whole or reduced, of which only its near part is drawn."""
    return part.masked(read(reduction))
