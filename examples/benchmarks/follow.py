"""Frames followed as they arrive: ``python -m examples.benchmarks.follow``.

A robot's drive of 640 x 480 frames is rendered into a temporary folder and followed, by one thread. Printed are the
processor time of a frame, reading and preview included, until λ is known and from then on; λ as it converges; how far
the path of the poses as they were first given is from the truth; and the largest memory after a third of the frames and
at the end.
"""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from examples.benchmarks.driver import peak_memory, run
from examples.judging.trajectories import compare_trajectories
from rdstitch.alignment.trajectory import Trajectory
from rdstitch.inputs.arrivals import Arrivals
from rdstitch.io.write import write_image
from rdstitch.options import StitchOptions
from rdstitch.pipeline.follow import Pose, follow
from tests.floor_drives import DISTORTION, floor_drive, true_path


def path_of(frames: list[Pose]) -> Trajectory:
    """The path of the poses as they were first given."""
    known = {frame.number: pose for frame in frames if frame.tracked and (pose := frame.tracked.pose)}
    numbers = sorted(known)
    places = np.array([(known[k].x, known[k].y) for k in numbers])
    yaw, height = (np.array([getattr(known[k], name) for k in numbers]) for name in ("yaw", "height"))
    return Trajectory(np.array(numbers), places, yaw, height)


def main(*, frames: int = 200, path: str = "turn", overlap: float = 0.9) -> None:
    """Print the figures."""
    cv2.setNumThreads(1)
    drive = floor_drive(path, frames, seed=3, overlap=overlap)
    with TemporaryDirectory() as folder:
        for index in range(frames):
            write_image(Path(folder) / f"frame_{index:05d}.jpg", drive.frame(index))
        arrivals = Arrivals(folder, frames_folder=lambda: Path(folder), idle=0.5)
        preview = Path(folder) / ".preview.jpg"
        found, spent, memory, last = list[Pose](), list[float](), 0.0, time.process_time()
        for frame in follow(arrivals, StitchOptions(workers=1), preview=preview, refresh=1.0):
            found.append(frame)
            spent.append((now := time.process_time()) - last)
            last = now
            if len(found) == frames // 3:
                memory = peak_memory()
    aligned = [k for k, frame in enumerate(found) if frame.tracked and frame.tracked.placement is not None]
    known = next((k for k, frame in enumerate(found) if frame.tracked and frame.tracked.distortion_known), 0)
    before, after = np.array(spent[:known]), np.array(spent[known:])
    print(f"ms a frame: {1e3 * before.mean():.1f} in the {known} frames before λ is known,", end=" ")
    print(f"{1e3 * after.mean():.1f} afterwards", end=" ")
    print(f"({1.0 / after.mean():.1f} frames a second; the slowest frame {1e3 * after.max():.0f} ms)")
    for share in (0.05, 0.1, 0.25, 0.5, 1.0):
        tracked = found[max(int(share * len(found)) - 1, 0)].tracked
        if tracked is not None:
            print(f"after {share:4.0%} of the frames: λ - truth {tracked.distortion - DISTORTION:+.5f}", end=" ")
            print(f"± {tracked.distortion_std:.5f}")
    error = compare_trajectories(path_of(found), true_path(drive))
    print(f"{len(aligned)} of {frames} frames placed; drift {error.drift:.3%} of the path")
    print(f"largest memory {memory:.0f} MB after a third, {peak_memory():.0f} MB at the end")


if __name__ == "__main__":
    run(main)
