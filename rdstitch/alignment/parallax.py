"""What the height of the ground moves in images: plane and parallax (Kumar, Anandan and Hanna 1994)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjuster, BundleAdjustmentResult
from rdstitch.alignment.least_squares.link_equations import LinearizedErrors, split_lens
from rdstitch.alignment.motion_models import LOG_HEIGHT, X, Y
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.geometry.division_model import distort, undistort
from rdstitch.geometry.radial_homography import inverses, project

_STEP = 1e-4  # heights, of differences
_ASIDE = 0.3  # half diagonals from the middle of an image, where its size on the ground is measured


@dataclass(frozen=True)
class Parallax:
    """Parallax of the images of an adjustment, by this adjuster or one with other weights."""

    adjuster: BundleAdjuster
    result: BundleAdjustmentResult

    @np.errstate(all="ignore")  # what lies beyond a horizon has no place
    def of(self, part: LinearizedErrors) -> tuple[FloatArray, FloatArray]:
        """The places (m, 2 or 3) of correspondences, and the errors (m, 2), pixels, of ground one unit higher there.

        The unit does not matter, since how high the ground is shows in the errors.
        """
        o, lens = self.adjuster.observations, self.result.parameters.lens
        link = o.link[part.rows]
        distortion, higher, centre = split_lens(lens)
        flat = undistort(o.points1[part.rows] - centre, distortion, higher)
        lifted = np.column_stack([flat, np.ones(len(flat))])
        place = self._places(np.einsum("mij,mj->mi", self._back[o.image1[link]], lifted))
        moved = [self._moved(place, images[link]) for images in (o.image1, o.image2)]
        errors = np.einsum("mij,mj->mi", part.by_point1, moved[0]) + np.einsum("mij,mj->mi", part.by_point2, moved[1])
        return place, np.nan_to_num(errors, posinf=0.0, neginf=0.0)

    @property
    def is_turn(self) -> bool:
        """Whether places are directions."""
        return self.adjuster.model.on_sphere

    @cached_property
    def size(self) -> float:
        """Size of half a diagonal of most images on the plane, or between directions."""
        return float(np.median(self._sizes))

    def from_middle(self, place: FloatArray) -> FloatArray:
        """Places (m, 2) from the middle of the images, in sizes of one; far beyond them (at a horizon), less far."""
        middle = np.median(self._centres, axis=0)
        reach = self.size + 2.0 * np.median(np.linalg.norm(self._centres - middle, axis=1))
        return np.clip(place - middle, -reach, reach) / self.size

    @cached_property
    def _back(self) -> FloatArray:
        """Image-to-plane homographies, or those to directions, (N, 3, 3)."""
        return inverses(self.result.matrices.matrices)

    def _places(self, lifted: FloatArray) -> FloatArray:
        """Places (m, 2) on the plane, or directions (m, 3), of homogeneous ones (m, 3)."""
        if not self.is_turn:
            return np.nan_to_num(project(lifted))
        unit: FloatArray = lifted / np.linalg.norm(lifted, axis=1, keepdims=True)
        return np.nan_to_num(unit)

    @cached_property
    def _centres(self) -> FloatArray:
        """What each image's centre shows, (N, 2 or 3)."""
        return self._places(self._back[:, :, 2])

    @cached_property
    def _sizes(self) -> FloatArray:
        """Sizes (N,) of half a diagonal of each image on the plane, or between directions."""
        aside = [self._places(self._back @ np.array([x, y, 1.0])) for x, y in ((_ASIDE, 0.0), (0.0, _ASIDE))]
        away = [np.linalg.norm(places - self._centres, axis=1) / _ASIDE for places in aside]
        return np.asarray(np.maximum((away[0] + away[1]) / 2.0, 1e-12))

    @cached_property
    def _nadirs(self) -> tuple[FloatArray, FloatArray]:
        """What each camera is above (N, 2), and how high it is (N,); roughly, in some unit, without poses."""
        model, parameters = self.adjuster.model, self.result.parameters
        if not model.has_metric_poses:
            return self._centres, self._sizes
        poses = model.metric_poses(parameters.poses, parameters.shared)
        return poses[:, [X, Y]], np.exp(poses[:, LOG_HEIGHT])

    def _moved(self, place: FloatArray, images: IntArray) -> FloatArray:
        """Motion (m, 2) of measured points of places in their images (m,) with the height of the ground."""
        if self.is_turn:  # any shift of the camera away from where it turns, one an image: nothing is known of them
            return np.random.default_rng(0).normal(size=(len(self._back), 2))[images]
        lens, matrices = self.result.parameters.lens, self.result.matrices.matrices[images]
        distortion, higher, _ = split_lens(lens)
        nadirs, heights = self._nadirs
        away = (place - nadirs[images]) / heights[images, None]
        ends = []
        for step in (_STEP, -_STEP):
            lifted = np.column_stack([place + step * self.size * away, np.ones(len(place))])
            ends.append(distort(project(np.einsum("mij,mj->mi", matrices, lifted)), distortion, higher))
        return (ends[0] - ends[1]) / (2.0 * _STEP)
