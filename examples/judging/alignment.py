"""How well an estimated registration agrees with the truth, from its numbers: no image is looked at."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from examples.judging.fitting import FITS, apply, quantile
from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.synthetic.rendering import Sequence

Transfer = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class AlignmentError:
    """Errors of a registration on a grid of points of its images, after the best transform to the true plane.

    ``error``: in px of that image: distance from the point to where the true camera sees the place on the plane that
    the estimate gives to it; inf where the estimate gives none, or one that the true camera cannot see; shape (N,).
    ``error_mosaic``: in px of the mosaic: distance between the estimated and the true place of the point; inf as above;
    shape (N,).
    """

    transform: FloatArray  # mosaic px to texels; shape (3, 3)
    image: NDArray[np.intp]  # which image each point is in; shape (N,)
    points: FloatArray  # measured px in that image; shape (N, 2)
    error: FloatArray
    error_mosaic: FloatArray

    @property
    def median(self) -> float:
        """Median of ``error``, px of the images."""
        return quantile(self.error, 0.5)

    @property
    def percentile95(self) -> float:
        """95 % of ``error`` are below this, px of the images."""
        return quantile(self.error, 0.95)

    @property
    def max(self) -> float:
        """Largest ``error``, px of the images."""
        return float(self.error.max())

    def per_image(self) -> dict[int, float]:
        """Median error of each image, px."""
        return {int(index): quantile(self.error[self.image == index], 0.5) for index in np.unique(self.image)}


def alignment_error(
    sequence: Sequence,
    transfers: Mapping[int, Transfer],
    *,
    model: str = "similarity",
    points_per_side: tuple[int, int] = (20, 15),
) -> AlignmentError:
    """Compare an estimated registration with the truth.

    A grid of points of each image is mapped by the estimate to the mosaic and by the truth to the plane; the
    transform between the two that minimises the sum of squared distances on the plane is what the mosaic is allowed to
    differ by; errors are what remains.

    ``transfers``: for each image that was registered: measured px (N, 2) to mosaic px (N, 2), NaN where there is no
    such place. ``model``: "similarity" or "homography": the transform to the plane. ``points_per_side``: columns and
    rows of the grid, from border to border. Raises :class:`ArgumentError` when nothing was registered.
    """
    width, height = sequence.lens.image_size
    columns, rows = points_per_side
    grid = np.meshgrid(np.linspace(0.0, width - 1.0, columns), np.linspace(0.0, height - 1.0, rows))
    points = np.stack(grid, axis=-1).reshape(-1, 2)
    indices = sorted(transfers)
    if not indices:
        raise ArgumentError("no image was registered")
    estimated = np.concatenate([np.asarray(transfers[index](points), dtype=np.float64) for index in indices])
    true = np.concatenate([sequence.to_plane(index, points) for index in indices])
    usable = np.isfinite(estimated).all(axis=1) & np.isfinite(true).all(axis=1)
    transform = FITS[model](estimated[usable], true[usable])

    on_plane = apply(transform, estimated)
    seen = np.concatenate(
        [sequence.to_image(index, part) for index, part in zip(indices, np.split(on_plane, len(indices)), strict=True)]
    )
    measured = np.tile(points, (len(indices), 1))
    return AlignmentError(
        transform=transform,
        image=np.repeat(np.array(indices, dtype=np.intp), len(points)),
        points=measured,
        error=_distance(seen, measured),
        error_mosaic=_distance(apply(np.linalg.inv(transform), true), estimated),
    )


def _distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Distances of points; inf where one is missing."""
    distance = np.linalg.norm(a - b, axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)
