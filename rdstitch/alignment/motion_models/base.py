"""What the adjustment uses of a motion model."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.choices import ModelName


@dataclass(frozen=True, eq=False)
class ModelMatrices:
    """Plane-to-image homographies of N images with their derivatives."""

    matrices: FloatArray  # (N, 3, 3)
    by_pose: FloatArray  # (N, D, 3, 3): By a step of the D pose parameters, as :meth:`MotionModel.retract` takes it
    by_shared: FloatArray  # (N, S, 3, 3): By the S shared parameters


class MotionModel(ABC):
    """A motion model, as the adjustment uses it."""

    name: ModelName
    pose_size: int  # free parameters per image, D
    shared_names: tuple[str, ...] = ()  # parameters that all images share, S of them, without those of the lens
    on_sphere: bool = False  # whether images lie around one centre, not over a plane
    # whether all images are of one camera with one focal length, the last of the shared parameters
    one_camera: bool = True
    # whether each image has a tilt of its own, and whether it may be any, not only differ a little from a shared one
    free_tilts: bool = False
    keeps_height: bool = False  # whether all images are at one height above a metric plane
    any_tilt: bool = False
    # Which columns of poses in a metric plane move, see :mod:`rdstitch.alignment.motion_models.planar`; none where
    # poses are of another kind
    free: tuple[int, ...] = ()

    @property
    def has_metric_poses(self) -> bool:
        """Whether all images are of one camera over a metric plane, with a position, a height and a tilt."""
        return bool(self.free)

    def metric_poses(self, poses: FloatArray, shared: FloatArray) -> FloatArray:
        """Poses (N, 6) in the metric plane; only of models that have them."""
        raise NotImplementedError(f"a model {self.name} has no metric poses")

    @property
    def gauge(self) -> BoolArray:
        """Gauge: which of the D parameters of the reference image the choice of the frame fixes, shape (D,); all."""
        return np.ones(self.pose_size, dtype=np.bool_)

    @abstractmethod
    def matrices(self, poses: FloatArray, shared: FloatArray) -> ModelMatrices:
        """Homographies from the plane to the images, with derivatives."""

    def physical_parameters(self, shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What :attr:`shared_names` names (S,), and its derivatives by the shared parameters (S, S)."""
        return shared, np.eye(len(shared))

    def shared_from_physical(self, physical: FloatArray) -> FloatArray:
        """The inverse of :meth:`physical_parameters`, also from those of a model with more of them."""
        return np.asarray(physical[len(physical) - len(self.shared_names) :], dtype=np.float64)

    def focal(self, shared: FloatArray) -> float:
        """Focal length of the one camera, half diagonals."""
        return float(np.exp(self.log_focal(shared)))

    def log_focal(self, shared: FloatArray) -> float:
        """Logarithm of the focal length, the last of the shared parameters."""
        return float(shared[-1])

    @abstractmethod
    def shared_starts(self, log_focal: float, tilt: Sequence[float], *, tilt_known: bool) -> list[FloatArray]:
        """Shared parameters (S,) near enough to any usual ones for an adjustment to converge from the nearest."""

    @abstractmethod
    def retract(self, poses: FloatArray, step: FloatArray) -> FloatArray:
        """Poses after a step of shape (N, D)."""

    def prior_coordinates(self, poses: FloatArray) -> FloatArray:
        """The D parameters of each image (N, D) that priors are on; zeros where there can be none."""
        return np.zeros((len(poses), self.pose_size))

    @abstractmethod
    def nominal_homographies(self, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """Homographies (N, 3, 3) of images at the origin of the plane, with the tilts (N, 2) given."""

    @abstractmethod
    def nearest_poses(self, homographies: FloatArray, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """The poses with these tilts (N, 2) that come nearest to plane-to-image homographies (N, 3, 3)."""

    def poses_from(
        self, other: "MotionModel", poses: FloatArray, shared: FloatArray, attitudes: FloatArray
    ) -> FloatArray:
        """Poses of another model as those of this one that come nearest to them, with its shared parameters."""
        of_camera = shared if self.one_camera else np.empty(0)
        return self.nearest_poses(other.matrices(poses, shared).matrices, of_camera, attitudes)

    @abstractmethod
    def description(self, poses: FloatArray, shared: FloatArray) -> str:
        """What a fit says of the camera."""
