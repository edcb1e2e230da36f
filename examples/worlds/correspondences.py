"""Matches of one pair of images, with noise and outliers and their truth."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from examples.worlds.instances import Instances, PlanarInstances, general_instances, planar_instances
from rdstitch.arrays import FloatArray
from rdstitch.features import Correspondences
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.feature_store import StoredMatches


def stored(points1: FloatArray, points2: FloatArray) -> StoredMatches:
    """Matches of two images, the i-th features of each, as good as any other."""
    indices = np.repeat(np.arange(len(points1))[:, None], 2, axis=1)
    return StoredMatches.of(Correspondences(indices, points1, points2, np.full(len(points1), 0.5)))


@dataclass(frozen=True)
class SyntheticMatches:
    """N matches between two images of a plane, some of them wrong."""

    points1: FloatArray  # measured pixels
    points2: FloatArray
    quality: FloatArray  # as a matcher would score them: right matches tend to be above wrong ones
    truth: RadialHomography  # with the motion where it is planar, and which matches are right

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """True for right matches, shape (N,)."""
        return self.truth.inliers


def correspondences(
    count: int = 400,
    *,
    seed: int,
    image_size: tuple[int, int] = (1000, 800),
    focal: float | None = None,
    distortion: float = -0.25,
    motion: str = "rigid",
    max_tilt: float = 0.1,
    overlap: float = 0.3,
    noise: float = 0.7,
    outliers: float = 0.3,
) -> SyntheticMatches:
    """Random matches of two images of a plane, in random order.

    ``focal`` is 1.2 half diagonals if not given; ``motion`` "rigid", "similarity" (heights change by up to a quarter)
    or "homography" (free motion before a tilted plane). Tilts are uniform in ±``max_tilt`` radians; ``outliers`` is the
    share of matches that lie anywhere in both images.
    """
    half_diagonal = float(np.hypot(*image_size)) / 2
    f = 1.2 * half_diagonal if focal is None else focal
    camera = Camera(image_size, distortion, focal=f, focal_source="option")
    half = (np.array(image_size) - 1.0) / 2.0
    right = count - round(count * outliers)
    # The longest motion is that which still leaves images of this field of view something in common.
    shared: dict[str, Any] = {
        "seed": seed,
        "distortion": (camera.distortion_px * f**2,) * 2,
        "translation": (0.1 * half_diagonal / f, 1.5 * half_diagonal / f),
        "half_size": tuple((half / f).tolist()),
        "overlap": overlap,
    }
    drawn: Instances
    if motion == "homography":
        drawn = general_instances(1, right, max_angle=max_tilt, **shared)
    else:
        change = 0.25 if motion == "similarity" else 0.0
        drawn = planar_instances(1, right, max_tilt=max_tilt, height=(1.0 - change, 1.0 + change), **shared)

    rng = np.random.default_rng((seed, 1))
    points1, points2 = (half * rng.uniform(-1.0, 1.0, (count, 2)) for _ in range(2))
    inliers = np.zeros(count, dtype=np.bool_)
    inliers[rng.permutation(count)[:right]] = True
    points1[inliers], points2[inliers] = f * drawn.x1[0], f * drawn.x2[0]
    points1[inliers] += noise * rng.standard_normal((right, 2))
    points2[inliers] += noise * rng.standard_normal((right, 2))
    quality = np.where(inliers, rng.beta(4.0, 2.0, count), rng.beta(2.0, 4.0, count))

    zoom = np.diag([f, f, half_diagonal])
    truth = RadialHomography(
        homography=zoom @ drawn.homography[0] @ np.linalg.inv(zoom),
        camera=camera,
        camera2=camera,
        inliers=inliers,
        distortion_std=0.0,
        model=motion,
        motion=drawn.motion(0) if isinstance(drawn, PlanarInstances) else None,
        rms=noise,
        solver="truth",
    )
    return SyntheticMatches(points1 + camera.center, points2 + camera.center, quality, truth)
