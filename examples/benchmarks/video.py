"""A video stitched as it is: ``python -m examples.benchmarks.video [--frames N] [--overlap SHARE] [--every N|auto]``.

A robot's drive of 640 x 480 frames is rendered, written as a Motion JPEG video and stitched by one thread in a process
of its own. Printed are the processor time of a frame of the video, of the whole and by stage; how many frames were
taken; the error of λ, and the errors of position of the frames taken; and how much of the ground that the video shows
is in the mosaic. Times depend on the machine: only those of one run compare.
"""

import json
import sys
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

import rdstitch
from examples.benchmarks.driver import StageTimes, apart, costliest, peak_memory, processor_time, run
from examples.judging import alignment_error
from rdstitch.radial_homography import to_plane
from rdstitch.synthetic import Sequence
from rdstitch.synthetic.poses import plane_outline
from tests.floor_drives import DISTORTION, floor_drive

_SEED = 3
_GRID = (5, 4)  # points of a frame at which its place is compared
_FRAMES_A_SECOND = 30.0


def write_video(sequence: Sequence, file: Path) -> None:
    """Render the frames into a video."""
    size = sequence.lens.image_size
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), _FRAMES_A_SECOND, size)
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 95)
    for index in range(len(sequence.poses.height)):
        writer.write(sequence.frame(index)[..., ::-1])
    writer.release()


def ground_shown(sequence: Sequence, frames: list[int]) -> float:
    """Share of the ground within all frames that is within some of them, on a raster of a hundredth of a frame."""
    step = max(sequence.lens.image_size) / 100.0
    outlines = [plane_outline(sequence.lens, sequence.from_plane(index)) / step for index in range(len(sequence))]
    least = np.min([outline.min(axis=0) for outline in outlines], axis=0)
    height, width = np.ceil(np.max([outline.max(axis=0) for outline in outlines], axis=0) - least).astype(int)[::-1]
    rasters = []
    for numbers in (range(len(sequence)), frames):
        raster = np.zeros((height + 1, width + 1), dtype=np.uint8)
        for index in numbers:
            cv2.fillPoly(raster, [np.round(outlines[index] - least).astype(np.int32)], 1)
        rasters.append(raster)
    return float(rasters[1].sum() / rasters[0].sum())


def measure(file: Path, sequence: Sequence, every: int | None) -> dict[str, Any]:
    """Stitch the video in this process; what that cost, and how near it came to the truth."""
    stages, before = StageTimes(), processor_time()
    options = rdstitch.StitchOptions(workers=1, overwrite=True, force=True)
    with TemporaryDirectory() as output:
        out = Path(output) / "out.jpg"
        registration = rdstitch.mosaic([file], out, options, every=every, progress=stages).registration
    seconds = processor_time() - before
    stages("the rest", 0, 0)
    alignment = registration.alignment
    numbers = [source.number(place) for place, source in enumerate(registration.sources)]
    used = np.flatnonzero(alignment.used).tolist()
    places = {numbers[i]: partial(to_plane, alignment.cameras[i], alignment.homographies[i]) for i in used}
    error = alignment_error(sequence, places, points_per_side=_GRID)
    return {
        "seconds": seconds,
        "memory": peak_memory(),
        "taken": len(numbers),
        "used": len(used),
        "distortion": alignment.distortion,
        "median": error.median,
        "percentile95": error.percentile95,
        "largest": error.max,
        "ground": ground_shown(sequence, sorted(places)),
        "stages": stages.spent,
    }


def main(
    *,
    frames: int = 400,
    path: str = "parking",
    overlap: float = 0.95,
    every: str = "auto",
    video: Path | None = None,
    run_here: bool = False,
) -> None:
    """Print the figures."""
    drive = floor_drive(path, frames, seed=_SEED, overlap=overlap)
    if run_here:
        assert video is not None
        print(json.dumps(measure(video, drive, None if every == "auto" else int(every))))
        return
    with TemporaryDirectory() as folder:
        file = video or Path(folder) / "drive.avi"
        if not file.exists():
            write_video(drive, file)
        row = apart("video", "--run-here", *sys.argv[1:], "--video", str(file))
    each = row["seconds"] / frames
    print(f"{row['seconds']:.1f} s, {each:.3f} s a frame; {row['memory']:.0f} MB", end="; ")
    print(f"{row['taken']} of {frames} frames taken, {row['used']} aligned; {row['ground']:.2%} of the ground")
    print(f"λ - truth {row['distortion'] - DISTORTION:+.5f}; error of position in px: median", end=" ")
    print(f"{row['median']:.3f}, 95 % {row['percentile95']:.3f}, largest {row['largest']:.3f}")
    print("ms a frame: " + costliest({stage: 1e3 * taken / frames for stage, taken in row["stages"].items()}))


if __name__ == "__main__":
    run(main)
