"""A robot's camera over a floor, as in the paper's §5.5: rendered frames, and the path that they were taken on."""

import csv
from functools import partial
from pathlib import Path

import numpy as np

from examples.worlds.paths import drive_poses
from rdstitch.alignment.result import PlanarPoses
from rdstitch.geometry.camera import Camera
from rdstitch.synthetic import Photometry, RenderedSequence, ground, sequence_over
from rdstitch.trajectories.trajectory import Trajectory

DISTORTION = -0.25

PATHS = ("line", "turn", "parking")


def floor_drive(
    path: str,
    count: int,
    *,
    seed: int,
    size: tuple[int, int] = (640, 480),
    overlap: float = 0.8,
) -> RenderedSequence:
    """Frames of one of :data:`PATHS`, through a lens of λ = :data:`DISTORTION` that is tilted by 3 and -2 degrees.

    ``count``: frames. ``seed``: of the floor and the noise. ``size``: width and height of the frames, px. ``overlap``:
    of consecutive frames.
    """
    lens = Camera(size, DISTORTION, focal=0.8 * size[0])
    poses = drive_poses(lens, path, count, overlap=overlap, heading=0.3, tilt=(np.radians(3.0), np.radians(-2.0)))
    floor = partial(ground, seed=seed)
    return sequence_over(floor, lens, poses, photometry=Photometry(noise=0.01), seed=seed)


def true_path(sequence: RenderedSequence) -> Trajectory:
    """The path of a sequence's camera, in units of its first height."""
    p, unit = sequence.poses, sequence.poses.height[0]
    return Trajectory.from_poses(PlanarPoses(p.yaw, p.position / unit, p.height / unit, p.tilt))


def read_path(file: Path) -> Trajectory:
    """The path of a CSV file that the command has written, z up."""
    with file.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    x, y, yaw, height = (np.array([float(row[name]) for row in rows]) for name in ("x", "y", "yaw_deg", "height"))
    frame = np.array([int(row["frame"]) for row in rows], dtype=np.intp)
    return Trajectory(frame, np.stack([x, -y], axis=1), np.radians(yaw), height)
