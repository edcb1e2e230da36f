"""Frames followed as they arrive: ``python -m examples.benchmarks.follow``.

A robot's drive of 640 x 480 frames is rendered into a folder, which may be kept for another run, and followed. Printed
are the processor time of a frame, reading and preview included, until λ is known and from then on: with one worker all
of it, with two that beside the process that aligns keyframes; λ as it converges; how far the path of the poses as they
were first given is from the truth, with ``--end`` that of ``rdstitch.trajectory`` too; and the largest memory after a
third of the frames and at the end.
"""

import time
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

import rdstitch
from examples.benchmarks.driver import run
from examples.judging.trajectories import compare_trajectories
from examples.worlds.floor_drives import DISTORTION, floor_drive, true_path
from rdstitch.inputs.frame_stream import open_frame_stream
from rdstitch.io.write import write_image
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.follow import follow
from rdstitch.results.pose import Pose
from rdstitch.system.process_memory import peak_memory
from rdstitch.tracking.preview import LivePreview
from rdstitch.trajectories.trajectory import Trajectory


def path_of(frames: list[Pose]) -> Trajectory:
    """The path of the poses as they were given last: a better alignment gives earlier ones again."""
    known = {frame.number: pose for frame in frames if (pose := frame.tracked.pose)}
    numbers = sorted(known)
    places = np.array([(known[k].x, known[k].y) for k in numbers])
    yaw, height = (np.array([getattr(known[k], name) for k in numbers]) for name in ("yaw", "height"))
    return Trajectory(np.array(numbers), places, yaw, height)


def end_error(estimate: Trajectory, truth: Trajectory) -> float:
    """How far the last position is from the truth where the first twentieth of the path lies on it, of its length."""
    _, rows, others = np.intersect1d(estimate.frame, truth.frame, return_indices=True)
    a, b = estimate.position[rows] @ [1.0, 1.0j], truth.position[others] @ [1.0, 1.0j]
    start = slice(0, max(2, len(a) // 20))
    a, b = a - a[start].mean(), b - b[start].mean()
    factor = np.vdot(a[start], b[start]) / np.vdot(a[start], a[start])
    return float(abs(factor * a[-1] - b[-1])) / truth.length


def main(
    *,
    frames: int = 200,
    path: str = "turn",
    overlap: float = 0.9,
    workers: int = 1,
    folder: Path | None = None,
    end: bool = False,
) -> None:
    """Print the figures."""
    cv2.setNumThreads(1)
    drive = floor_drive(path, frames, seed=3, overlap=overlap)
    truth, options = true_path(drive), StitchOptions(workers=workers)
    with TemporaryDirectory() if folder is None else nullcontext(folder) as kept:
        images = Path(kept)
        for index in range(frames):
            if not (file := images / f"frame_{index:05d}.jpg").exists():
                write_image(file, drive.frame(index))
        arrivals = open_frame_stream(images, frames_folder=lambda: images, idle=0.5)
        preview = LivePreview(images / ".preview.jpg", 1.0)
        poses, spent, memory, last = list[Pose](), list[float](), 0.0, time.process_time()
        for frame in follow(arrivals, options, preview=preview):
            poses.append(frame)
            spent.append((now := time.process_time()) - last)
            last = now
            if len(poses) == frames // 3:
                memory = peak_memory()
        whole = rdstitch.trajectory([images], None, options)[0] if end else None
    placed = {frame.number for frame in poses if frame.tracked.placement is not None}
    unknown = [k for k, frame in enumerate(poses) if not frame.tracked.distortion_known]
    for name, rows in (("λ unknown", unknown), ("λ known", sorted({*range(len(poses))} - {*unknown}))):
        if rows:
            part = np.array(spent)[rows]
            print(
                f"{name}: {len(rows)} frames, {1e3 * part.mean():.1f} ms a frame ({1.0 / part.mean():.1f} frames",
                end=" ",
            )
            print(f"a second), {1e3 * part.max():.0f} ms the slowest")
    for share in (0.05, 0.1, 0.25, 0.5, 1.0):
        tracked = poses[max(int(share * len(poses)) - 1, 0)].tracked
        print(f"after {share:4.0%} of the frames: λ - truth {tracked.distortion - DISTORTION:+.5f}", end=" ")
        print(f"± {tracked.distortion_std:.5f}")
    print(f"{len(placed)} of {frames} frames placed, along {truth.length:.0f} heights of the camera")
    for name, one in (("while driving", path_of(poses)), ("at the end", whole)):
        if one is not None:
            error = compare_trajectories(one, truth)
            print(f"{name}: drift {error.drift:.4%} of the path, {end_error(one, truth):.3%} at its end")
    print(f"largest memory {memory:.0f} MB after a third, {peak_memory():.0f} MB at the end")


if __name__ == "__main__":
    run(main)
