"""End to end: rendered sets stitched by rdstitch and by the peers, each mosaic laid on the true plane."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from examples.judging import compare_with_plane
from examples.paper.common.report import Effort, Pixels, Report, Settings, Table
from examples.paper.common.stitchers import Stitcher, installed_stitchers, run_all
from rdstitch.geometry.camera import Camera
from rdstitch.io.read import read_image
from rdstitch.synthetic import Photometry, RenderedSequence, grid_poses, ground, sequence_over

HEADER = (
    "stitcher", "exit", "median error, px", "95 % error, px", "coverage, %", "λ error",
    "time, s", "processor time, s", "memory, MB", "last words",
)  # fmt: skip

SEARCH = 16  # px of the mosaic about each of its places, within which the place is looked for in the truth

Measured = tuple[float, float, float]


@dataclass(frozen=True)
class ImageSet:
    """A grid of views of a floor, to be rendered."""

    name: str
    size: tuple[int, int]
    grid: tuple[int, int]
    focal: float
    distortion: float
    tilt: tuple[float, float]  # degrees
    yaw: float  # degrees, ±

    def sequence(self, seed: int) -> RenderedSequence:
        """The images, with exposures that differ by ±15 %."""
        lens = Camera(self.size, self.distortion, focal=self.focal, focal_source="option")
        psi, theta = np.radians(self.tilt)
        poses = grid_poses(lens, *self.grid, yaw=math.radians(self.yaw), shift=0.1, tilt=(psi, theta), seed=seed)
        gain = np.random.default_rng(seed).uniform(0.85, 1.15, len(poses))
        photometry = Photometry(gain=gain, noise=0.005, blur=0.4)
        return sequence_over(lambda size: ground(size, seed), lens, poses, photometry=photometry, seed=seed)

    @property
    def field_of_view(self) -> float:
        """Horizontal, of a lens without distortion, degrees."""
        return math.degrees(2.0 * math.atan(self.size[0] / 2.0 / self.focal))


SETS = (
    ImageSet("4x3 views, λ = -0.25", (640, 480), (4, 3), 520.0, -0.25, (2.5, -2.0), 8.0),
    ImageSet("6x2 views, λ = -0.25", (800, 600), (6, 2), 650.0, -0.25, (2.0, -1.5), 8.0),
    ImageSet("4x3 views, λ = -0.45", (640, 480), (4, 3), 420.0, -0.45, (-6.0, 5.0), 15.0),
    ImageSet("4x3 views, λ = 0", (640, 480), (4, 3), 520.0, 0.0, (0.0, 0.0), 180.0),
)
_TINY = ImageSet("2x1 views", (320, 240), (2, 1), 260.0, -0.25, (2.5, -2.0), 8.0)


def run(settings: Settings) -> Report:
    """Registration error, coverage, λ, time, memory and exit status of every stitcher that is installed."""
    stitchers, notes = installed_stitchers(settings.peer_python)
    chosen = [_TINY] if settings.effort is Effort.TINY else SETS[: settings.count(1, 1, len(SETS))]
    return compare(settings, "end_to_end", chosen, 100, stitchers, notes, _measured)


def _measured(mosaic: Pixels, sequence: RenderedSequence, _: ImageSet) -> Measured:
    """Errors are given in px of the images, for mosaics of any scale."""
    found = compare_with_plane(mosaic, sequence.texture, reachable=sequence.reachable(), search=SEARCH)
    return found.median * found.texels_per_pixel, found.percentile95 * found.texels_per_pixel, found.coverage


def compare(
    settings: Settings,
    name: str,
    sets: Sequence[Any],
    first_seed: int,
    stitchers: Sequence[Stitcher],
    notes: tuple[str, ...],
    measured: Callable[[Pixels, Any, Any], Measured],
) -> Report:
    """Every set through every stitcher, a table a set.

    ``name``: of the figure; images are named after it. ``first_seed``: of the first set. ``notes``: on stitchers that
    are not installed. ``measured``: takes a mosaic, the truth and the set; gives the median error and 95 % of them, px
    of the images, inf beyond what was searched, and the share that is covered.
    """
    timeout = float(settings.count(60, 120, 600))
    tables, images = [], {}
    for number, chosen in enumerate(sets):
        with TemporaryDirectory(prefix="rdstitch-peers-") as folder:
            sequence = chosen.sequence(seed=first_seed + number)
            files, rows = sequence.write(folder), []
            for k, stitcher in enumerate(stitchers[:2] if settings.effort is Effort.TINY else stitchers):
                own = Path(folder) / f"stitcher{k}"
                own.mkdir()
                done = run_all(stitcher.commands(files, own / "mosaic.tif", chosen.field_of_view), own, timeout)
                mosaic = read_mosaic(own) if done.ok else None
                figures = (None, None, None) if mosaic is None else _shown(*measured(mosaic, sequence, chosen))
                distortion_error = distortion_error_of(own / "mosaic.tif", sequence)
                status = "time is up" if done.status is None else str(done.status)
                cost = (done.seconds, done.processor_seconds, done.megabytes, "" if done.ok else done.said)
                rows.append((stitcher.name, status, *figures, distortion_error, *cost))
                if mosaic is not None:
                    images[f"{name}_set{number}_{k}.jpg"] = mosaic[:, :, :3] if mosaic.ndim == 3 else mosaic
        title = f"{name.replace('_', ' ').capitalize()}: {chosen.name}, {chosen.size[0]}x{chosen.size[1]} px"
        tables.append(Table(title, HEADER, tuple(rows)))
    return Report(tuple(tables), images=images, notes=notes)


def _shown(median: float, percentile95: float, coverage: float) -> tuple[object, ...]:
    """As the table has it."""
    return *(error if np.isfinite(error) else f"> {SEARCH}" for error in (median, percentile95)), 100.0 * coverage


def read_mosaic(folder: Path) -> Pixels | None:
    """What the stitcher wrote; RGB or grey, with alpha where it has one."""
    written = sorted(folder.glob("mosaic*.tif")) + sorted(folder.glob("mosaic*.jpg"))
    if not written:
        return None
    image: Any = read_image(written[0])
    pixels = np.asarray(image.pixels)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if image.alpha is None:
        return pixels
    colours = pixels if pixels.ndim == 3 else np.repeat(pixels[:, :, None], 3, axis=2)
    alpha = (np.asarray(image.alpha) > 0).astype(np.uint8) * np.uint8(255)
    return np.concatenate([colours, alpha[:, :, None]], axis=2)


def distortion_error_of(output: Path, sequence: Any) -> float | None:
    """|λ - λ_true| where the stitcher has told its λ."""
    told = Path(f"{output}.json")
    if not told.is_file() or not isinstance(sequence.lens, Camera):
        return None
    content = json.loads(told.read_text(encoding="utf-8"))
    return abs(float(content["lambda"]) - sequence.lens.distortion)
