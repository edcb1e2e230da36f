"""How the global adjustment grows with the number of frames, and how near it comes to the truth.

Run as ``python -m examples.benchmarks.adjustment [COUNT …]``.
Links are synthesised along a robot's path (a line, a turn, a parallel-parking path), around a ring that closes, or over
a survey of parallel lanes. Printed are processor times per frame, and relative to the shortest sequence of the same
run; the largest memory so far; and the drift, as the root mean square and as the largest error of a position in per
cent of the path.
"""

import math
import time
from typing import Literal

import numpy as np

from examples.benchmarks.driver import peak_memory, run
from examples.judging.trajectories import compare_trajectories
from rdstitch.alignment import AlignmentOptions, align
from rdstitch.alignment.motion_models import LOG_HEIGHT, PSI, THETA, YAW, X, Y
from rdstitch.alignment.result import PlanarPoses
from rdstitch.alignment.trajectory import Trajectory
from rdstitch.arrays import FloatArray
from tests.alignment_scenes import Scene, grid, ring, robot_path, scene

_STEP = 0.15  # heights between frames of a path


def synthesised(path: str, count: int, links: int) -> Scene:
    """Links of ``count`` frames, each with the ``links`` next ones; in a survey with those that overlap."""
    rng = np.random.default_rng(count)
    if path == "survey":
        side = math.isqrt(count)
        poses = grid(side, count // side, (0.6, 0.45), 0.05, rng)
        return scene(poses, tilt=(-0.1, 0.087), noise=0.4, overlap=0.3, per_link=150, rng=rng)
    poses = ring(count, _STEP) if path == "ring" else robot_path(count, _STEP)
    closed = path == "ring"
    return scene(poses, tilt=(-0.1, 0.087), noise=0.4, overlap=0.3, reach=links, closed=closed, per_link=150, rng=rng)


def true_path(poses: FloatArray) -> Trajectory:
    """The path through true poses (N, 6)."""
    heights = np.exp(poses[:, LOG_HEIGHT])
    return Trajectory.from_poses(PlanarPoses(poses[:, YAW], poses[:, [X, Y]], heights, poses[:, [PSI, THETA]]))


def largest_error(found: Trajectory, truth: Trajectory) -> float:
    """Largest distance of a position from the true one after the best similarity, as a share of the path."""
    shared = np.isin(truth.frame, found.frame)
    one, two = (places @ np.array([1.0, 1.0j]) for places in (found.position, truth.position[shared]))
    one, two = one - one.mean(), two - two.mean()
    return float(np.abs(np.vdot(one, two) / np.vdot(one, one) * one - two).max()) / truth.length


def main(
    counts: tuple[int, ...] = (40, 80, 160, 320),
    *,
    path: Literal["robot", "ring", "survey"] = "robot",
    links: int = 6,
    model: tuple[str, ...] = ("auto", "homography"),
) -> None:
    """Print one line per model and number of frames."""
    columns = "model|frames|aligned|links|s|ms/frame|ratio|MB|chosen|Δλ|transl. %|rot. °|drift %|largest %"
    print("".join(f"{column:>11}" for column in columns.split("|")))
    for one in model:
        first = math.nan
        for count in counts:
            made = synthesised(path, count, links)
            begin = time.process_time()
            found = align(made.cameras, made.links, AlignmentOptions(model=one))
            seconds = time.process_time() - begin
            each = seconds / count * 1e3
            first = each if math.isnan(first) else first
            memory = peak_memory()
            row = f"{one:>11}{count:11d}{int(found.used.sum()):11d}{len(made.links):11d}"
            row += f"{seconds:11.1f}{each:11.1f}{each / first:11.2f}"
            row += f"{memory:11.0f}{found.model:>11}{found.distortion - made.distortion:11.5f}"
            if found.poses is not None:
                run_path, truth = Trajectory.from_alignment(found), true_path(made.poses)
                error = compare_trajectories(run_path, truth)
                row += f"{100 * error.translation_in_own_unit:11.4f}{math.degrees(error.rotation):11.4f}"
                row += f"{100 * error.drift:11.4f}{100 * largest_error(run_path, truth):11.4f}"
            print(row, flush=True)


if __name__ == "__main__":
    run(main)
