"""Local alignment measured on rendered rough ground: python -m tests.benchmarks.local_alignment [--sets N].

Every set is a flight over hills ("bumps"), buildings or ridges ("slopes") of 2, 5 and 10 % of the camera's height, or
over a plane, rendered, registered by the whole pipeline, and put together with ``--local-alignment`` off and auto.
Printed are medians over the sets:

median, 95 %
    How far two images are apart on the ground where a seam divides them, pixels, without and with.
over 1
    Share of the seams' length along which they are farther apart than 1 pixel, per cent, without and with; and along
    seams that avoid the true displacements ("ideal"): no seam finder can do much better between walls and what they
    hide.
line
    How much a line that is straight on the ground bends within one image as it is put into the output, pixels, root
    mean square, without and with: what is mended must be more than what is bent.
worse
    Sets in which the median or the 95 % across the seams grew by more than 5 % and 0.05 pixels.
share
    Processor time of local alignment by that of the registration, per cent.

``--folders`` prints for real images how far matches that are held out of the fit are apart, without and with.
"""

import argparse
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing import Canvas, CompositeOptions, plan_canvas
from rdstitch.compositing.photometric import no_exposure
from rdstitch.compositing.placed_image import PlacedImage, place_images
from rdstitch.compositing.preparation import prepare_composite
from rdstitch.compositing.seam_finder import NO_OWNER, SeamMap, find_seams
from rdstitch.compositing.source_images import ImageReader
from rdstitch.compositing.survey import survey_images
from rdstitch.errors import RdstitchError
from rdstitch.executors import open_executor
from rdstitch.inputs.source import read_sources
from rdstitch.local_alignment import LocalAlignment, no_local_alignment
from rdstitch.options import StitchOptions
from rdstitch.pipeline.accept import accept
from rdstitch.pipeline.placed_images import align_registration_locally
from rdstitch.pipeline.register import register
from rdstitch.radial_homography import to_plane
from rdstitch.registration import Registration
from rdstitch.synthetic import RELIEFS, Photometry, Sequence, ground, sequence_over, survey_poses

LENS = Camera((640, 480), -0.2, focal=520.0)
HEIGHTS = (0.02, 0.05, 0.1)
_LINES, _POINTS = 40, 25
_BRIGHTNESS_PER_PIXEL = 0.02  # of displacement, where seams avoid that


@dataclass(frozen=True)
class Apart:
    """Distances on the ground of the two images on either side of the seams, pixels."""

    median: float
    percentile95: float
    beyond_a_pixel: float

    @classmethod
    def of(cls, distances: FloatArray) -> Self:
        """From all of them; where one of the images sees no ground counts not."""
        found = distances[np.isfinite(distances)]
        return cls(float(np.median(found)), float(np.percentile(found, 95)), float(np.mean(found > 1.0)))


@dataclass(frozen=True)
class Figures:
    """Of one set: across the seams without, with, and along ideal seams; bend of lines without and with; time."""

    off: Apart
    on: Apart
    ideal: Apart
    bend: tuple[float, float]
    share: float

    @property
    def worse(self) -> bool:
        """Whether anything got worse across the seams."""
        off, on = ((apart.median, apart.percentile95) for apart in (self.off, self.on))
        return any(b > max(1.05 * a, a + 0.05) for a, b in zip(off, on, strict=True))


def sequence(kind: str, height: float, seed: int, images: int) -> Sequence:
    """A small flight over rough ground."""
    poses = survey_poses(LENS, images, forward_overlap=0.6, side_overlap=0.5, attitude_jitter=0.02, seed=seed)
    relief = None if kind == "flat" else lambda size: RELIEFS[kind](size, seed, height=height * 520.0)
    return sequence_over(
        lambda size: ground(size, seed, 1), LENS, poses, relief=relief, seed=seed, photometry=Photometry(noise=0.01)
    )


def across_seams(truth: Sequence, registration: Registration, local: LocalAlignment, *, ideal: bool = False) -> Apart:
    """Along the seams that are found; ``ideal``: along those that are found where the truth is known instead."""
    alignment = registration.alignment
    used = np.flatnonzero(alignment.used)
    sources, _ = read_sources([registration.sources[k].path for k in used], camera=None, focal=None, distortion=None,
                              skip_bad=False)  # fmt: skip
    cameras, matrices = [alignment.cameras[k] for k in used], alignment.homographies[used]
    canvas, read = plan_canvas(cameras, matrices), [source.read for source in sources]
    fields = list(local.fields) or None
    placed = place_images(read, cameras, matrices, preview=read, displacement=fields)
    with prepare_composite(placed, canvas, CompositeOptions()) as ready:
        seams, warps = ready.renderer.seams, ready.renderer.warps
    if ideal:
        seams = _ideal_seams(truth, used, placed, canvas)
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
    return Apart.of(np.concatenate(distances))


def _ideal_seams(truth: Sequence, used: NDArray[np.intp], placed: list[PlacedImage], canvas: Canvas) -> SeamMap:
    """Seams between images that show, in place of brightness, which place on the ground each pixel sees."""
    survey = survey_images(ImageReader(placed), placed, canvas)
    tiles = []
    for number, tile, warp in zip(used, survey.tiles, survey.warps, strict=True):
        assert tile is not None
        left, top, right, bottom = map(float, tile.box)
        x, y = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
        seen = truth.to_ground(int(number), warp.source_points(x.ravel(), y.ravel())).reshape(*x.shape, 2)
        shown = np.concatenate([np.nan_to_num(seen), np.zeros((*x.shape, 1))], axis=2) * _BRIGHTNESS_PER_PIXEL
        tiles.append(replace(tile, pixels=shown.astype(np.float32)))
    return find_seams(replace(survey, tiles=tuple(tiles)), no_exposure(len(placed), 3), graphcut=True)


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
            pixels = truth.ground_to_image(int(k), start + share * (end - start))
            aligned = pixels
            for _ in range(10 if local.fields else 0):
                aligned = pixels - local.fields[position](aligned)
            placed = scale * to_plane(camera, matrix, aligned)
            placed = placed[np.isfinite(placed).all(axis=1)]
            if len(placed) == _POINTS:
                centred = placed - placed.mean(axis=0)
                squares.append(np.linalg.svd(centred, compute_uv=False)[1] ** 2 / _POINTS)
    return float(np.sqrt(np.mean(squares))) if squares else np.nan


def measure(kind: str, height: float, seed: int, images: int) -> Figures:
    """One set through the pipeline."""
    truth = sequence(kind, height, seed, images)
    with tempfile.TemporaryDirectory() as folder:
        registration, local, share = aligned(truth.write(folder))
        off = no_local_alignment("off")
        apart = [across_seams(truth, registration, which) for which in (off, local)]
        ideal = across_seams(truth, registration, off, ideal=True)
        bends = [line_bend(truth, registration, which, seed) for which in (off, local)]
    return Figures(apart[0], apart[1], ideal, (bends[0], bends[1]), share)


def aligned(paths: list[Path]) -> tuple[Registration, LocalAlignment, float]:
    """Registration, local alignment, and the processor time of this by the time of that, per cent."""
    sources, _ = read_sources(paths, camera=None, focal=None, distortion=None, skip_bad=False)
    options = StitchOptions(workers=1, threshold=3.0)
    start = time.process_time()
    with open_executor(1, len(sources)) as executor:
        registration = accept(register(sources, options, executor, skip_bad=True), options, executor)
    registered = time.process_time()
    local = align_registration_locally(registration, "auto")
    return registration, local, 100.0 * (time.process_time() - registered) / (registered - start)


def held_out(folder: Path) -> str:
    """A line on real images: how far matches that are held out of the fit are apart, without and with."""
    names = (path for path in sorted(folder.iterdir()) if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".tif"))
    registration, local, share = aligned(list(names))
    used = f"{folder.name}: {registration.alignment.used.sum()} images"
    if local.before is None or local.after is None:
        return f"{used}, {local.reason}"
    apart = (f"{held.median:.2f}, {held.percentile95:.2f}" for held in (local.before, local.after))
    return f"{used}, median and 95 % {' -> '.join(apart)} pixels, {share:.1f} % of the time; {local.reason}"


def table(rows: dict[str, list[Figures]]) -> str:
    """Medians over the sets of each kind."""
    names = f"{'median':>12} {'95 %':>13} {'over 1':>13} {'ideal':>6} {'line':>12} {'worse':>6} {'share':>6}"
    lines = [f"{'':16} sets {names}"]
    for name, figures in rows.items():
        if figures:
            apart = [(f.off.median, f.on.median, f.off.percentile95, f.on.percentile95) for f in figures]
            beyond = [[100.0 * a.beyond_a_pixel for a in (f.off, f.on, f.ideal)] for f in figures]
            m, p = np.median(apart, axis=0), np.median(beyond, axis=0)
            bend, share = np.median([f.bend for f in figures], axis=0), np.median([f.share for f in figures])
            worse = sum(f.worse for f in figures)
            lines.append(
                f"{name:16} {len(figures):4} {m[0]:6.2f}{m[1]:6.2f} {m[2]:7.2f}{m[3]:6.2f} {p[0]:6.1f}{p[1]:6.1f}% "
                f"{p[2]:5.1f}% {bend[0]:6.2f}{bend[1]:6.2f} {worse:6} {share:5.1f}%"
            )
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=["flat", *RELIEFS], help="flat, bumps, buildings, slopes")
    parser.add_argument("--sets", type=int, default=3)
    parser.add_argument("--first", type=int, default=1, help="seed of the first set")
    parser.add_argument("--images", type=int, default=6)
    parser.add_argument("--heights", type=float, nargs="*", default=HEIGHTS, help="shares of the camera's height")
    parser.add_argument("--folders", type=Path, nargs="*", help="of real images: matches held out of the fit instead")
    arguments = parser.parse_args()
    if arguments.folders:
        for folder in arguments.folders:
            print(held_out(folder), flush=True)
        return
    rows: dict[str, list[Figures]] = {}
    kinds = [
        (name, height) for name in arguments.kinds for height in (arguments.heights if name in RELIEFS else (0.0,))
    ]
    for kind, height in kinds:
        name = kind if kind == "flat" else f"{kind} {height:.0%}"
        rows[name] = []
        for seed in range(arguments.first, arguments.first + arguments.sets):
            try:
                rows[name].append(measure(kind, height, seed, arguments.images))
            except RdstitchError as error:
                print(f"{name}, set {seed}: {error}")
            print(table({f"{name}, to {seed}": rows[name]}), flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
