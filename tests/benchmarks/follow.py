"""Frames followed as they arrive: ``python -m tests.benchmarks.follow [--frames N] [--path PATH] [--overlap SHARE]``.

A robot's drive of 640 x 480 frames is rendered into a temporary folder and followed, by one thread. Printed are the
processor time of a frame, reading and preview included, until λ is known and from then on; λ as it converges; how far
the path of the poses as they were first given is from the truth; and the largest memory after a third of the frames and
at the end.
"""

import argparse
import resource
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from rdstitch.alignment.trajectory import Trajectory, compare_trajectories
from rdstitch.inputs.arrivals import Arrivals
from rdstitch.io.write import write_image
from rdstitch.options import StitchOptions
from rdstitch.pipeline.follow import Pose, follow
from tests.floor_drives import DISTORTION, PATHS, floor_drive, true_path


def path_of(frames: list[Pose]) -> Trajectory:
    """The path of the poses as they were first given."""
    known = {frame.number: pose for frame in frames if frame.tracked and (pose := frame.tracked.pose)}
    numbers = sorted(known)
    places = np.array([(known[k].x, known[k].y) for k in numbers])
    yaw, height = (np.array([getattr(known[k], name) for k in numbers]) for name in ("yaw", "height"))
    return Trajectory(np.array(numbers), places, yaw, height)


def peak() -> float:
    """Largest memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description="Frame rate and accuracy of --follow")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--path", choices=sorted(PATHS), default="turn")
    parser.add_argument("--overlap", type=float, default=0.9, help="of frames that follow one another")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    drive = floor_drive(given.path, given.frames, seed=3, overlap=given.overlap)
    with TemporaryDirectory() as folder:
        for index in range(given.frames):
            write_image(Path(folder) / f"frame_{index:05d}.jpg", drive.frame(index))
        arrivals = Arrivals(folder, frames_folder=lambda: Path(folder), idle=0.5)
        preview = Path(folder) / ".preview.jpg"
        found, spent, memory, last = list[Pose](), list[float](), 0.0, time.process_time()
        for frame in follow(arrivals, StitchOptions(workers=1), preview=preview, refresh=1.0):
            found.append(frame)
            spent.append((now := time.process_time()) - last)
            last = now
            if len(found) == given.frames // 3:
                memory = peak()
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
    print(f"{len(aligned)} of {given.frames} frames placed; drift {error.drift:.3%} of the path")
    print(f"largest memory {memory:.0f} MB after a third, {peak():.0f} MB at the end")


if __name__ == "__main__":
    main()
