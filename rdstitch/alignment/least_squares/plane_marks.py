"""Marks on the plane, as ground control points are: where images show them, and where they are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.alignment.least_squares.link_equations import split_lens
from rdstitch.alignment.motion_models import ModelMatrices
from rdstitch.arrays import BoolArray, FloatArray, IntArray, Rows
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.division_model import undistort
from rdstitch.geometry.radial_homography import inverses

_STEP = 1e-6  # of a lens parameter, for derivatives


@dataclass(frozen=True)
class Sighting:
    """A ground control point in an image."""

    image: int
    offset: tuple[float, float]  # from the distortion centre, pixels of the camera
    name: str
    place: tuple[float, float]  # metres east and north
    std: float | None = None  # of one coordinate of the place, m, where that is known


@dataclass(frozen=True, eq=False)
class ControlPoints(Rows):
    """M sightings of ground control points."""

    name: NDArray[np.str_]  # (M,)
    place: FloatArray  # (M, 2): metres east and north
    std: FloatArray  # (M,): of one coordinate, m; 0 where that is not known
    image: IntArray  # (M,)
    points: FloatArray  # (M, 2): measured, in half diagonals from the distortion centre
    pixel: FloatArray  # (M,): a pixel, half diagonals

    @classmethod
    def of(cls, sightings: Sequence[Sighting], cameras: Sequence[Camera]) -> Self:
        """The sightings in images of these cameras."""
        for one in sightings:
            if not 0 <= one.image < len(cameras):
                raise ArgumentError(f"control point {one.name} is in image {one.image}, of {len(cameras)}")
            if not (np.isfinite([*one.offset, *one.place]).all() and 0.0 <= (one.std or 0.0) < np.inf):
                raise ArgumentError(f"control point {one.name}: place, offset and standard deviation must be finite")
        pixel = np.array([1.0 / cameras[one.image].scale for one in sightings])
        return cls(
            np.array([one.name for one in sightings], dtype=np.str_),
            np.array([one.place for one in sightings]).reshape(-1, 2),
            np.array([one.std or 0.0 for one in sightings]),
            np.array([one.image for one in sightings], dtype=np.intp),
            np.array([one.offset for one in sightings]).reshape(-1, 2) * pixel[:, None],
            pixel,
        )

    def within(self, images: IntArray) -> Self:
        """The sightings in some of the images (N,), ascending, which get the numbers 0 to N - 1."""
        shown = self.take(np.isin(self.image, images))
        return replace(shown, image=np.searchsorted(images, shown.image).astype(np.intp))


@dataclass(frozen=True, eq=False)
class PlaneMarks:
    """M sightings of marks by a planar model; errors are on the plane, multiplied by the focal length as poses are."""

    image: IntArray  # (M,)
    points: FloatArray  # (M, 2): measured, in half diagonals from the distortion centre
    target: FloatArray  # (M, 2): where the marks are
    precision: FloatArray  # (M,): inverse variance of a coordinate

    def places(self, matrices: FloatArray, lens: FloatArray, focal: float) -> FloatArray:
        """Where images with plane-to-image matrices (N, 3, 3) put the marks, (M, 2)."""
        lifted = self._lifted(matrices, lens)[0]
        return focal * lifted[:, :2] / lifted[:, 2:]

    def cost(self, matrices: FloatArray, lens: FloatArray, focal: float) -> float:
        """Squared errors over their variances."""
        errors = self.places(matrices, lens, focal) - self.target
        return float((self.precision[:, None] * errors**2).sum())

    def equations(
        self, matrices: ModelMatrices, lens: FloatArray, free_lens: BoolArray, focal: float
    ) -> tuple[FloatArray, FloatArray]:
        """Errors (M, 2); derivatives (M, 2, D + S + K) by pose, shared parameters, of which log f is last, and lens."""
        lifted, inverse = self._lifted(matrices.matrices, lens)
        by_matrix = np.concatenate([matrices.by_pose, matrices.by_shared], axis=1)[self.image]
        moved = -np.einsum("mij,mpjk,mk->mpi", inverse, by_matrix, lifted)
        steps = [_STEP * unit for unit in np.eye(len(lens))[free_lens]]
        ends = [[self._lifted(matrices.matrices, lens + sign * step)[0] for sign in (1.0, -1.0)] for step in steps]
        by_lens = [(after - before)[:, None] / (2.0 * _STEP) for after, before in ends]
        moved = np.concatenate([moved, *by_lens], axis=1)
        place = lifted[:, :2] / lifted[:, 2:]
        by_lifted = (moved[..., :2] - place[:, None] * moved[..., 2:]) / lifted[:, None, 2:]
        derivative = focal * by_lifted.transpose(0, 2, 1)
        derivative[:, :, by_matrix.shape[1] - 1] += focal * place
        return focal * place - self.target, derivative

    def _lifted(self, matrices: FloatArray, lens: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The marks on the plane (M, 3), homogeneous, and the matrices from their images to it (M, 3, 3)."""
        distortion, higher, center = split_lens(lens)
        inverse = inverses(matrices)[self.image]
        points = undistort(self.points - center, distortion, higher)
        return np.einsum("mij,mj->mi", inverse, np.column_stack([points, np.ones(len(points))])), inverse
