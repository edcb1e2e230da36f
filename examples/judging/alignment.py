"""How well an estimated registration agrees with the truth, from its numbers: no image is looked at."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from examples.judging.fitting import FITS, apply, quantile
from rdstitch.alignment import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.synthetic.rendering import RenderedSequence

Transfer = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class AlignmentError:
    """Errors of a registration on a grid of points of its images, after the best transform to the true plane.

    ``error``: in px of that image: distance from the point to where the true camera sees the place on the plane that
    the estimate gives to it; inf where the estimate gives none, or one that the true camera cannot see; shape (N,).
    """

    transform: FloatArray  # mosaic px to texels; shape (3, 3)
    image: NDArray[np.intp]  # which image each point is in; shape (N,)
    error: FloatArray

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
    sequence: RenderedSequence,
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
    distance = np.linalg.norm(seen - np.tile(points, (len(indices), 1)), axis=1)
    image = np.repeat(np.array(indices, dtype=np.intp), len(points))
    return AlignmentError(transform, image, np.where(np.isfinite(distance), distance, np.inf))


def registration_error(
    alignment: Alignment,
    sequence: RenderedSequence,
    model: str | None = None,
    order: Sequence[int] | None = None,
    points_per_side: tuple[int, int] = (20, 15),
) -> AlignmentError:
    """:func:`alignment_error` of images that were aligned.

    ``model``: what the plane may differ by; if not given, a rectified one by a similarity, the frame of an image by a
    homography. ``order``: which image of the sequence each one is, if they are not in its order.
    """
    places = {
        i if order is None else order[i]: partial(to_plane, alignment.cameras[i], alignment.homographies[i])
        for i in np.flatnonzero(alignment.used).tolist()
    }
    model = model or ("homography" if alignment.poses is None else "similarity")
    return alignment_error(sequence, places, model=model, points_per_side=points_per_side)
