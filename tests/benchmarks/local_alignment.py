"""Local alignment measured on rendered rough ground: python -m tests.benchmarks.local_alignment [--sets N].

Every set is a flight over hills ("bumps"), buildings or ridges ("slopes") of 2, 5 and 10 % of the camera's height, or
over a plane, rendered, registered by the whole pipeline, and put together with ``--local-alignment`` off and auto.
Printed are medians over the sets:

across the seams
    How far two pictures are apart on the ground where a seam divides them, px: median and 95 %, without and with.
line
    How much a line that is straight on the ground bends within one picture as it is put into the output, px, root mean
    square, without and with: what is mended must be more than what is bent.
worse
    Sets in which the median or the 95 % across the seams grew by more than 5 % and 0.05 px.
share
    Processor time of local alignment by that of the registration, per cent.
"""

import argparse
import tempfile
import time
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing import CompositeOptions, plan_canvas
from rdstitch.compositing.placed_picture import place_pictures
from rdstitch.compositing.preparation import prepare_composite
from rdstitch.compositing.seam_finder import NO_OWNER
from rdstitch.errors import RdstitchError
from rdstitch.executors import open_executor
from rdstitch.inputs.source import read_sources, readers
from rdstitch.local_alignment import LocalAlignment, no_local_alignment
from rdstitch.options import StitchOptions
from rdstitch.pipeline.accept import accept
from rdstitch.pipeline.align_locally import align_registration_locally
from rdstitch.pipeline.register import register
from rdstitch.radial_homography import to_plane
from rdstitch.registration import Registration
from rdstitch.synthetic import RELIEFS, Photometry, Sequence, ground, sequence_over, survey_poses

LENS = Camera((640, 480), -0.2, focal=520.0)
HEIGHTS = (0.02, 0.05, 0.1)
_LINES, _POINTS = 40, 25


@dataclass(frozen=True)
class Figures:
    """Of one set: across the seams without and with (median, 95 %), bend of lines without and with, share of time."""

    off: tuple[float, float]
    on: tuple[float, float]
    bend: tuple[float, float]
    share: float

    @property
    def worse(self) -> bool:
        """Whether anything got worse across the seams."""
        return any(b > max(1.05 * a, a + 0.05) for a, b in zip(self.off, self.on, strict=True))


def sequence(kind: str, height: float, seed: int, pictures: int) -> Sequence:
    """A small flight over rough ground."""
    poses = survey_poses(LENS, pictures, forward_overlap=0.6, side_overlap=0.5, attitude_jitter=0.02, seed=seed)
    relief = None if kind == "flat" else lambda size: RELIEFS[kind](size, seed, height=height * 520.0)
    return sequence_over(
        lambda size: ground(size, seed, 1), LENS, poses, relief=relief, seed=seed, photometry=Photometry(noise=0.01)
    )


def across_seams(truth: Sequence, registration: Registration, local: LocalAlignment) -> tuple[float, float]:
    """Median and 95 % of the distance on the ground of the two pictures on either side of the seams, px."""
    alignment = registration.alignment
    used = np.flatnonzero(alignment.used)
    sources, _ = read_sources([registration.sources[k].path for k in used], camera=None, focal=None, distortion=None,
                              skip_bad=False)  # fmt: skip
    cameras, matrices = [alignment.cameras[k] for k in used], alignment.homographies[used]
    canvas, read = plan_canvas(cameras, matrices), readers(sources)
    fields = list(local.fields) or None
    with prepare_composite(
        place_pictures(read, cameras, matrices, preview=read, displacement=fields), canvas, CompositeOptions()
    ) as ready:
        seams, warps = ready.renderer.seams, ready.renderer.warps
    assert seams is not None
    distances = []
    for axis in (0, 1):
        a, b = np.delete(seams.labels, -1, axis), np.delete(seams.labels, 0, axis)
        y, x = np.nonzero((a != b) & (a != NO_OWNER) & (b != NO_OWNER))
        place = [seams.factor * (v + 0.5) - 0.5 for v in (x, y)]
        for first, second in sorted({*zip(a[y, x].tolist(), b[y, x].tolist(), strict=True)}):
            here = (a[y, x] == first) & (b[y, x] == second)
            grounds = [
                truth.to_ground(int(used[k]), warps[k].source_points(place[0][here], place[1][here]))
                for k in (first, second)
            ]
            distances.append(np.linalg.norm(grounds[0] - grounds[1], axis=1))
    found = np.concatenate(distances)
    found = found[np.isfinite(found)]
    return float(np.median(found)), float(np.percentile(found, 95))


def line_bend(truth: Sequence, registration: Registration, local: LocalAlignment, seed: int) -> float:
    """Root mean square distance from a straight line, px, of lines that are straight on the ground."""
    rng, alignment = np.random.default_rng(seed), registration.alignment
    squares = []
    for position, k in enumerate(np.flatnonzero(alignment.used)):
        camera, matrix = alignment.cameras[k], alignment.homographies[k]
        scale = camera.half_diagonal
        ends = truth.to_ground(int(k), rng.uniform((40, 40), (599, 439), (2 * _LINES, 2))).reshape(-1, 2, 2)
        share = np.linspace(0.0, 1.0, _POINTS)[:, None]
        for start, end in ends:
            pixels = truth.ground_to_picture(int(k), start + share * (end - start))
            aligned = pixels
            for _ in range(10 if local.fields else 0):
                aligned = pixels - local.fields[position](aligned)
            placed = scale * to_plane(camera, matrix, aligned)
            placed = placed[np.isfinite(placed).all(axis=1)]
            if len(placed) == _POINTS:
                centred = placed - placed.mean(axis=0)
                squares.append(np.linalg.svd(centred, compute_uv=False)[1] ** 2 / _POINTS)
    return float(np.sqrt(np.mean(squares))) if squares else np.nan


def measure(kind: str, height: float, seed: int, pictures: int) -> Figures:
    """One set through the pipeline."""
    truth = sequence(kind, height, seed, pictures)
    with tempfile.TemporaryDirectory() as folder:
        paths = truth.write(folder)
        sources, _ = read_sources(paths, camera=None, focal=None, distortion=None, skip_bad=False)
        options = StitchOptions(workers=1, threshold=3.0)
        start = time.process_time()
        with open_executor(1, len(sources)) as executor:
            registration = accept(register(sources, options, executor, skip_bad=True), options)
        registered = time.process_time()
        local = align_registration_locally(registration, "auto")
        done = time.process_time()
        off = no_local_alignment("off")
        both = [across_seams(truth, registration, which) for which in (off, local)]
        bends = [line_bend(truth, registration, which, seed) for which in (off, local)]
    return Figures(both[0], both[1], (bends[0], bends[1]), 100.0 * (done - registered) / (registered - start))


def table(rows: dict[str, list[Figures]]) -> str:
    """Medians over the sets of each kind."""
    lines = [f"{'':16} {'sets':>4} {'without':>15} {'with':>15} {'line':>13} {'worse':>5} {'share':>6}"]
    for name, figures in rows.items():
        if figures:
            values: FloatArray = np.median([(*f.off, *f.on, *f.bend, f.share) for f in figures], axis=0)
            worse = sum(f.worse for f in figures)
            lines.append(
                f"{name:16} {len(figures):4} {values[0]:7.2f} {values[1]:7.2f} {values[2]:7.2f} {values[3]:7.2f} "
                f"{values[4]:6.2f} {values[5]:6.2f} {worse:5} {values[6]:5.1f}%"
            )
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=3)
    parser.add_argument("--pictures", type=int, default=6)
    arguments = parser.parse_args()
    rows: dict[str, list[Figures]] = {}
    for kind, height in [("flat", 0.0), *((kind, height) for kind in RELIEFS for height in HEIGHTS)]:
        name = kind if kind == "flat" else f"{kind} {height:.0%}"
        rows[name] = []
        for seed in range(1, arguments.sets + 1):
            try:
                rows[name].append(measure(kind, height, seed, arguments.pictures))
            except RdstitchError as error:
                print(f"{name}, set {seed}: {error}")
        print(table({name: rows[name]}), flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
