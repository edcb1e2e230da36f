"""Cost and accuracy by the number of frames: ``python -m examples.benchmarks.scale [COUNT …]``.

A drone's survey of 480 x 360 frames, or of another ``--size``, one lane beside the other, is rendered frame by frame
into a temporary folder (60 kB a frame) and stitched by one worker, or ``--workers``, in a process of its own. Printed
are processor time and peak memory by stage; the error of λ; the median error of frames against those beside them, and
the median and largest of their positions after the best similarity of all, also as a share of the path; and seconds of
the main thread, and their share: with two workers or more, what no further one shortens, and the encoder, which works
beside them. Times depend on the machine: only those of one run compare.

``--drawn``: matches are drawn instead of found, and nothing is composited, so that alignment, loop closure, checks by
matches and local alignment of 10,000 frames take minutes.
"""

import json
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import thread_time
from typing import Any, cast

import numpy as np

import rdstitch
from examples.benchmarks.drawn_matches import DrawnMatches
from examples.benchmarks.driver import StagePeaks, StageTimes, apart, costliest, processor_time, run
from examples.judging import registration_error
from examples.worlds.paths import survey_poses
from rdstitch.alignment import Alignment
from rdstitch.arrays import evenly_spaced
from rdstitch.errors import InputError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.frame import DeferredImage, Frame
from rdstitch.inputs.source import read_sources
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage
from rdstitch.io.write import write_image
from rdstitch.matching.pair_estimator import PairEstimator
from rdstitch.matching.two_view import PairRegistration
from rdstitch.pipeline.composition.lay_out import align_registration_locally
from rdstitch.pipeline.registration.aligner import Aligner
from rdstitch.pipeline.registration.redraft import draft_with_loops
from rdstitch.pipeline.registration.working_size import at_full_size
from rdstitch.results.registration import Registration
from rdstitch.synthetic import Photometry, RenderedSequence, blank, ground, sequence_over
from rdstitch.system.cache import Cache
from rdstitch.system.process_memory import forget_peak_memory, take_over_memory
from rdstitch.system.progress import Progress
from rdstitch.verification.evidence import ResultEvidence
from rdstitch.verification.verdict import failures_of_matches

COUNTS = (300, 1000, 3000, 10_000)
DISTORTION = -0.25
SIZE = "480x360"
_SEED = 19
_GRID = (5, 4)  # points of a frame at which its place is compared
_LINKS = 2000  # of which the error of one frame against the other is taken


def survey(count: int, size: str = SIZE, *, rendered: bool = True) -> RenderedSequence:
    """A drone's survey of ``count`` frames that overlap by 70 % along a lane and by 50 % across."""
    width, height = map(int, size.split("x"))
    lens = Camera((width, height), DISTORTION, focal=0.8 * width)
    poses = survey_poses(lens, count, attitude_jitter=0.01, tilt=(0.02, -0.03), seed=_SEED)
    plane = partial(ground, seed=_SEED) if rendered else lambda size: blank((1, 1))
    return sequence_over(plane, lens, poses, photometry=Photometry(noise=0.01), seed=_SEED)


def frame_order(count: int, shuffled: bool) -> list[int]:
    """Which frame of the survey the i-th image of the folder is."""
    return np.random.default_rng(_SEED).permutation(count).tolist() if shuffled else list(range(count))


def write_frames(sequence: RenderedSequence, order: list[int], folder: Path) -> None:
    """Render the frames into a folder, one at a time."""
    for place, index in enumerate(order):
        write_image(folder / f"frame_{place:05d}.jpg", sequence.frame(index))


def measure(
    folder: Path, sequence: RenderedSequence, order: list[int], workers: int, *, register_only: bool, drawn: bool
) -> dict[str, Any]:
    """Stitch a folder of rendered frames in this process; what that cost, and how near it came to the truth."""
    drafts = iter(("draft",))

    def note(stage: str, done: int, total: int) -> None:
        stages(stage, done, total)
        serial(stage, done, total)
        peaks(stage, done, total)

    count = len(sequence)
    matches = DrawnMatches(sequence, progress=lambda *_: note(next(drafts, "closing loops"), 1, 1))
    pairs = matches.first() if drawn else []
    stages, serial, peaks, before = StageTimes(), StageTimes(thread_time), StagePeaks(), processor_time()
    take_over_memory()  # as the command does
    forget_peak_memory()
    options = rdstitch.StitchOptions(workers=workers, overwrite=True, force=True)
    if drawn:
        registration = aligned_by_drawn(matches, pairs, options, note)
    elif register_only:
        registration = rdstitch.calibrate([folder], options, progress=note)
    else:
        with TemporaryDirectory() as output:
            registration = rdstitch.mosaic([folder], Path(output) / "out.tif", options, progress=note).registration
    seconds = processor_time() - before
    note("the rest", 0, 0)
    alignment = registration.alignment
    error = registration_error(alignment, sequence, "similarity", order, _GRID)
    positions = sequence.poses.position / sequence.poses.height[0] * sequence.lens.focal
    path = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    return {
        "count": count,
        "seconds": seconds,
        "memory": max(peaks.held.values()),
        "used": int(alignment.used.sum()),
        "pairs": len(registration.pairs),
        "distortion": alignment.distortion,
        "local": local_error(alignment, sequence, order),
        "largest": error.max,
        "median": error.median,
        "path": path,
        "stages": stages.spent,
        "serial": serial.spent,
        "peaks": peaks.held,
    }


def local_error(alignment: Alignment, sequence: RenderedSequence, order: list[int]) -> float:
    """Median distance, pixels, from where the alignment transfers points of a frame to, to where another shows them."""
    size, links = np.array(sequence.lens.image_size), list(alignment.support)
    grid = np.stack(np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in _GRID)), axis=-1).reshape(-1, 2) * (size - 1.0)
    errors = []
    for i, j in (links[k] for k in evenly_spaced(len(links), _LINKS)):
        seen = sequence.to_image(order[j], sequence.to_plane(order[i], grid))
        inside = ((seen >= 0.0) & (seen < size)).all(axis=1)
        errors.append(np.linalg.norm(alignment.transfer(i, j, grid) - seen, axis=1)[inside])
    return float(np.median(np.concatenate(errors)))


def aligned_by_drawn(
    matches: DrawnMatches, pairs: list[PairRegistration], options: rdstitch.StitchOptions, note: Progress
) -> Registration:
    """The stages after matching that look at no pixels."""
    size, count = matches.sequence.lens.image_size, len(matches.sequence)
    metadata = Metadata(size)
    frames = [Frame(Path(f"frame_{k:05d}.jpg"), image=DeferredImage(metadata, _no_pixels)) for k in range(count)]
    sources = read_sources(frames, skip_bad=False)[0]
    options = options.for_images(count)
    aligner = Aligner.of(sources, options, Cache())
    draft = draft_with_loops(aligner, cast(PairEstimator, matches), pairs, matches.pairs)
    note("closing loops", 1, 1)
    aligned = aligner.completed(draft)
    note("aligning", 1, 1)
    keypoints = tuple(len(points) for points, _ in matches.keypoints)
    registration = Registration(tuple(sources), keypoints, tuple(aligner.used(aligned)), aligned.alignment, ())
    failures_of_matches(ResultEvidence(registration, options.threshold))
    note("checking matches", 1, 1)
    align_registration_locally(at_full_size(registration), "auto")
    note("local alignment", 1, 1)
    return registration


def _no_pixels() -> DecodedImage:
    raise InputError("drawn matches have no pixels")


def print_row(row: dict[str, Any], first: dict[str, Any]) -> None:
    """One line a number of frames, and one of its costliest stages."""
    count, each = row["count"], 1e3 * row["seconds"] / row["count"]
    line = f"{count:8d}{row['seconds']:10.1f}{each:10.1f}"
    line += f"{each / (1e3 * first['seconds'] / first['count']):8.2f}{row['memory']:10.0f}"
    growth = (row["memory"] - first["memory"]) / max(count - first["count"], 1)
    line += f"{growth:10.2f}" if row is not first else f"{'':10s}"
    line += f"{row['used']:8d}{row['pairs'] / count:10.1f}{row['distortion'] - DISTORTION:11.6f}"
    line += f"{row['local']:9.3f}{row['median']:9.3f}{row['largest']:9.3f}{100 * row['largest'] / row['path']:10.4f}"
    print(line, flush=True)
    for unit, values in (
        ("ms/frame", {stage: 1e3 * taken / count for stage, taken in row["stages"].items()}),
        ("MB", row["peaks"]),
        (f"main thread, {sum(row['serial'].values()) / row['seconds']:.0%}", row["serial"]),
    ):
        print(f"{'':8s}{unit}: {costliest(values, 6)}", flush=True)


def main(
    counts: tuple[int, ...] = COUNTS,
    *,
    size: str = SIZE,
    shuffled: bool = False,
    register: bool = False,
    drawn: bool = False,
    workers: int = 1,
    folder: Path | None = None,
) -> None:
    """Print the table; or, in a process of its own, one row of it as JSON."""
    if folder is not None:
        sequence, order = survey(counts[0], size, rendered=False), frame_order(counts[0], shuffled)
        print(json.dumps(measure(folder, sequence, order, workers, register_only=register, drawn=drawn)))
        return
    widths = {"s": 10, "ms/frame": 10, "ratio": 8, "MB": 10, "MB/frame": 10, "used": 8, "pairs/fr.": 10, "Δλ": 11}
    widths |= {"local": 9, "median": 9, "largest": 9, "% of path": 10}
    print(f"{'frames':>8}" + "".join(f"{name:>{width}}" for name, width in widths.items()))
    first: dict[str, Any] | None = None
    for count in counts:
        with TemporaryDirectory() as rendered:
            if not drawn:
                write_frames(survey(count, size), frame_order(count, shuffled), Path(rendered))
            options = ["--shuffled"] * shuffled + ["--register"] * register + ["--drawn"] * drawn
            row = apart("scale", str(count), "--folder", rendered, "--size", size, "--workers", str(workers), *options)
        first = first or row
        print_row(row, first)


if __name__ == "__main__":
    run(main)
