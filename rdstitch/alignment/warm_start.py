"""Where an alignment starts that follows another of the same images: at the cameras and poses of that one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.alignment.bundle_adjustment import Parameters
from rdstitch.alignment.motion_models import LOG_HEIGHT, MODELS, PSI, THETA, PlanarModel, X, Y
from rdstitch.alignment.result import Alignment
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.camera import Camera


@dataclass(frozen=True)
class WarmStart:
    """The solution of an earlier alignment over a plane; heights are relative to their median."""

    model: PlanarModel
    parameters: Parameters
    tilt_spread: float

    @classmethod
    def of(
        cls,
        former: Alignment,
        cameras: Sequence[Camera],
        images: IntArray,
        lens: FloatArray,
        free_lens: BoolArray,
    ) -> Self | None:
        """From an alignment of the same ``cameras``; None where it was not of these ``images`` over a plane.

        What is not free of the lens (5,) stays as given.
        """
        model = MODELS[former.model]
        poses, tilt, focal = former.poses, former.tilt, former.focal
        same = np.array_equal(np.flatnonzero(former.used), images)
        if not isinstance(model, PlanarModel) or poses is None or tilt is None or focal is None or not same:
            return None
        own = np.empty((len(images), 6))
        logs = np.log(poses.height[images])
        median = float(np.median(logs))
        own[:, 0] = poses.yaw[images]
        own[:, [X, Y]] = poses.position[images] * focal / np.exp(median)
        own[:, LOG_HEIGHT] = logs - median
        own[:, [PSI, THETA]] = (poses.tilt[images] - np.array(tilt)) / focal  # free, or zero
        found, given = former.cameras[0], cameras[0]
        center = (np.asarray(found.center) - np.asarray(given.center)) / given.scale
        lens = np.where(free_lens, [*found.coefficients, *center], lens)
        shared = model.shared_from_physical(np.array([*tilt, np.log(focal)]))
        return cls(model, Parameters(own, shared, lens), former.tilt_spread)

    def start_of(self, model: PlanarModel) -> Parameters:
        """For any model over a plane: what is not free in that is the same in all images."""
        poses = np.zeros_like(self.parameters.poses)
        poses[:, list(model.free)] = self.parameters.poses[:, list(model.free)]
        return Parameters(poses, self.parameters.shared, self.parameters.lens)
