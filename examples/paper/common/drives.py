"""The paper's drives (§5.5) as matches between frames, synthesised from true poses without rendering anything."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from examples.worlds.paths import drive_poses
from rdstitch.alignment import Link
from rdstitch.alignment.result import PlanarPoses
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.robust import SolverName, estimate_radial_homography
from rdstitch.synthetic import Poses
from rdstitch.synthetic.poses import pixels_of_texels, texels_of_pixels
from rdstitch.trajectories.trajectory import Trajectory

PATHS = {"line": "line", "turn": "turn", "parallel parking": "parking"}

_STEPS = (1, 2, 4)
_MIN_MATCHES = 30
_PER_IMAGE = 200
_WRONG = 0.1  # share of the matches


@dataclass(frozen=True)
class FramePair:
    """Matches between two frames, px, in the order of their indices."""

    image1: int
    image2: int
    points1: FloatArray
    points2: FloatArray


@dataclass(frozen=True)
class Drive:
    """A robot's drive."""

    camera: Camera  # the true one
    tilt: tuple[float, float]  # (ψ, θ), radians
    poses: Poses  # true ones
    pairs: tuple[FramePair, ...]  # consecutive frames and frames two and four apart

    @property
    def truth(self) -> Trajectory:
        """The true path."""
        unit = self.poses.height[0]
        p = self.poses
        return Trajectory.from_poses(PlanarPoses(p.yaw, p.position / unit, p.height / unit, p.tilt))

    @property
    def blank_cameras(self) -> list[Camera]:
        """Of each frame, what is known before: size and focal length."""
        camera = Camera(self.camera.image_size, focal=self.camera.focal, focal_source="option")
        return [camera] * len(self.poses)


def drive(path: str, frames: int, *, seed: int, noise: float = 0.5) -> Drive:
    """One of :data:`PATHS`, seen by a tilted camera with strong barrel distortion.

    ``seed``: of the matches. ``noise``: standard deviation of the noise of the points, px.
    """
    camera = Camera((640, 480), -0.3, focal=520.0, focal_source="option")
    tilt = (np.radians(4.0), np.radians(-3.0))
    poses = drive_poses(camera, PATHS[path], frames, tilt=tilt)
    rng = np.random.default_rng(seed)
    pairs = []
    for first in range(frames):
        for step in _STEPS:
            if first + step < frames:
                points = _matches(camera, poses.from_plane()[[first, first + step]], noise, rng)
                if len(points[0]) >= _MIN_MATCHES:
                    pairs.append(FramePair(first, first + step, *points))
    return Drive(camera, tilt, poses, tuple(pairs))


def estimated_links(pairs: Iterable[FramePair], camera: Camera, solver: SolverName = "auto") -> list[Link]:
    """What rdstitch makes of each pair, for the adjustment; pairs for which it finds nothing are left out.

    ``camera``: of all frames, as far as it is known before. ``solver``: see
    :func:`rdstitch.estimate_radial_homography`.
    """
    links = []
    for pair in pairs:
        relation = estimate_radial_homography(
            pair.points1,
            pair.points2,
            camera.image_size,
            focal=camera.focal,
            focal_source=camera.focal_source,
            solver=solver,
        )
        if relation:
            keep = relation.inliers
            links.append(Link(pair.image1, pair.image2, pair.points1[keep], pair.points2[keep], relation))
    return links


def _matches(
    camera: Camera, from_plane: FloatArray, noise: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Noisy matches between two images, some of them wrong."""
    limit = np.array(camera.image_size) - 1.0
    points1 = rng.uniform((0.0, 0.0), limit, (_PER_IMAGE, 2))
    points2 = pixels_of_texels(camera, from_plane[1], texels_of_pixels(camera, from_plane[0], points1))
    seen = ((points2 >= 0.0) & (points2 <= limit)).all(axis=1)
    points1, points2 = points1[seen], points2[seen]
    wrong = rng.random(len(points2)) < _WRONG
    points2[wrong] = rng.uniform((0.0, 0.0), limit, (int(wrong.sum()), 2))
    return points1 + noise * rng.standard_normal(points1.shape), points2 + noise * rng.standard_normal(points2.shape)
