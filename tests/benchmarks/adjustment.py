"""How the global adjustment grows with the number of frames, and how near it comes to the truth.

Run as ``python -m tests.benchmarks.adjustment``. Links are synthesised along a robot's path (a line, a turn, a
parallel-parking path). Times are given per frame, and relative to the shortest sequence of the same run.
"""

import math
import time
from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.align import AlignmentOptions, align
from rdstitch.alignment.motion_models import LOG_HEIGHT, PSI, THETA, YAW, X, Y
from rdstitch.alignment.result import PlanarPoses
from rdstitch.alignment.trajectory import Trajectory, compare_trajectories
from tests.alignment_scenes import robot_path, scene


def main(counts: Sequence[int] = (40, 80, 160, 320), models: Sequence[str] = ("auto", "homography")) -> None:
    """Print one line per model and number of frames."""
    columns = ("model", "frames", "links", "ms/frame", "ratio", "chosen", "Δλ", "transl. %", "rot. °", "drift %")
    print("".join(f"{column:>11}" for column in columns))
    for model in models:
        first = math.nan
        for count in counts:
            rng = np.random.default_rng(count)
            given = scene(
                robot_path(count, 0.15), tilt=(-0.1, 0.087), noise=0.4, overlap=0.3, reach=6, per_link=150, rng=rng
            )
            begin = time.perf_counter()
            found = align(given.cameras, given.links, AlignmentOptions(model=model))
            each = (time.perf_counter() - begin) / count * 1e3
            first = each if math.isnan(first) else first
            row = f"{model:>11}{count:11d}{len(given.links):11d}{each:11.1f}{each / first:11.2f}{found.model:>11}"
            row += f"{found.distortion - given.distortion:11.5f}"
            if found.poses is not None:
                p = given.poses
                heights = np.exp(p[:, LOG_HEIGHT])
                truth = Trajectory.from_poses(PlanarPoses(p[:, YAW], p[:, [X, Y]], heights, p[:, [PSI, THETA]]))
                error = compare_trajectories(Trajectory.from_alignment(found), truth)
                row += f"{100 * error.translation_in_own_unit:11.4f}{math.degrees(error.rotation):11.4f}"
                row += f"{100 * error.drift:11.4f}"
            print(row)


if __name__ == "__main__":
    main()
