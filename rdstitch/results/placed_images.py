"""Registered images, ready to be composited: aligned locally, without what is static."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.compositing import Canvas
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.compositing.static_pixels import MIN_IMAGES, static_pixels
from rdstitch.compositing.visible_region import VisibleRegion
from rdstitch.geometry.camera import Camera
from rdstitch.georeferencing.georeference import Georeference
from rdstitch.georeferencing.place_on_map import AlignmentErrors, has_place
from rdstitch.inputs.source import Source
from rdstitch.io.radiometric_tags import Radiometry
from rdstitch.io.read import DecodedImage
from rdstitch.io.reduction import fitting_reduction
from rdstitch.local_alignment import DisplacementField
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

    sources: Sequence[Source]  # with the cameras that were found
    # (N, 3, 3): normalized undistorted coordinates of each image to the plane, or to directions
    homographies: FloatArray
    reference: int | None  # image whose resolution the output has; None for the median one's
    # what local alignment adds to the measured pixels of each image
    displacements: Sequence[DisplacementField | None] | None = None
    # whether the camera turned on the spot, so that the homographies lead to directions, not to a plane
    turned: bool = False
    place: Georeference | None = None  # of the plane, where it is known from an earlier run
    tiles: bool = False  # of a stage: nothing of them is static, though their ground may be black
    # (3, 3): what the homographies were turned by; see :mod:`rdstitch.pipeline.composition.straighten`
    orientation: FloatArray | None = None
    errors: AlignmentErrors = field(default_factory=AlignmentErrors)
    grid: SavedGrid | None = None  # pixels that the output is made on

    @classmethod
    def of(cls, registration: Registration, displacements: Sequence[DisplacementField | None] | None) -> Self:
        """Those that a registration uses."""
        alignment = registration.alignment
        used = np.flatnonzero(alignment.used)
        return cls(
            [replace(registration.sources[i], camera=alignment.cameras[i]) for i in used],
            alignment.homographies[used],
            int(np.flatnonzero(used == alignment.reference)[0]),
            displacements,
            alignment.on_sphere,
            tiles=registration.tiles is not None,
            errors=AlignmentErrors(
                alignment.relief.size if alignment.relief.found else 0.0,
                alignment.lever_std or None,
                [alignment.leverage.get(i, 0.0) for i in used.tolist()],
                {key: value for key, value in alignment.leverage.items() if isinstance(key, str)},
            ),
        )

    @property
    def profile_source(self) -> Source:
        """The image whose colour profile the output has: the first in colours, where any is."""
        return next((source for source in self.sources if source.metadata.channels > 2), self.sources[0])

    @cached_property
    def cameras(self) -> list[Camera]:
        """Those of the images."""
        return [source.camera for source in self.sources]

    @cached_property
    def _common_size(self) -> tuple[int, int]:
        return Counter(camera.image_size for camera in self.cameras).most_common(1)[0][0]

    @cached_property
    def static(self) -> NDArray[np.bool_] | None:
        """What shows the camera's parts, or nothing, in a few images of the commonest size; None where none does."""
        alike = [source for source in self.sources if source.camera.image_size == self._common_size]
        if self.tiles or len(alike) < MIN_IMAGES:
            return None
        chosen = evenly_spaced(len(alike), _STATIC_SAMPLE).tolist()
        reduction = fitting_reduction(max(self._common_size) / _STATIC_SIDE)
        return static_pixels([alike[k].read(reduction, keep=True).pixels for k in chosen])

    @property
    def has_place(self) -> bool:
        """Whether enough is known for a place of the output on the Earth to be expected."""
        return not self.turned and has_place(self.sources)

    def images(self, canvas: Canvas) -> list[PlacedImage]:
        """As the compositor takes them, with only the near parts of those that a canvas does not show whole."""
        displacements = self.displacements or [None] * len(self.sources)
        statics = [self.static if camera.image_size == self._common_size else None for camera in self.cameras]
        images = zip(self.sources, self.homographies, canvas.near, displacements, statics, strict=True)
        return [
            PlacedImage(
                partial(_read_drawn, source, part, static),
                source.camera,
                homography,
                exposure=source.metadata.exposure,
                displacement=displacement,
                path=str(source.path),
                radiometry=source.metadata.radiometry
                or (Radiometry() if self.place is not None or source.metadata.gps else None),
                coloured=source.metadata.channels in (3, 4),
                transparent=source.may_be_transparent or self.static is not None,
            )
            for source, homography, part, displacement, static in images
        ]


def _read_drawn(
    source: Source, part: VisibleRegion | None, static: NDArray[np.bool_] | None, reduction: int = 1
) -> DecodedImage:
    """An image, whole or reduced, with what is not near, and what is static, transparent."""
    image = source.read(reduction)
    if part is not None:
        image = part.masked(image)
    if static is None:
        return image
    height, width = image.pixels.shape[:2]
    rows, columns = np.arange(height) * static.shape[0] // height, np.arange(width) * static.shape[1] // width
    alpha = np.full((height, width), 255, dtype=np.uint8) if image.alpha is None else image.alpha
    return replace(image, alpha=np.where(static[np.ix_(rows, columns)], np.uint8(0), alpha))
