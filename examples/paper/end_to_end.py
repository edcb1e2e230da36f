"""End to end: rendered sets stitched by rdstitch and by the peers, each mosaic laid on the true plane."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from examples.judging import PlaneComparison, compare_with_plane
from examples.paper.common.report import Pixels, Report, Table
from examples.paper.common.settings import Effort, Settings
from examples.paper.common.stitchers import Stitcher, installed_stitchers
from examples.paper.common.subprocesses import Run, run_all
from rdstitch.camera import Camera
from rdstitch.io.read import read_image
from rdstitch.synthetic import Photometry, Sequence, grid_poses, ground, sequence_over

HEADER = (
    "stitcher",
    "exit",
    "median error, px",
    "95 % error, px",
    "coverage, %",
    "λ error",
    "time, s",
    "processor time, s",
    "memory, MB",
    "last words",
)


_SEARCH = 16  # px of the mosaic about each of its places, within which the place is looked for on the plane


@dataclass(frozen=True)
class PictureSet:
    """A grid of views of a floor, to be rendered."""

    name: str
    size: tuple[int, int]
    grid: tuple[int, int]
    focal: float
    distortion: float
    tilt: tuple[float, float]  # degrees
    yaw: float  # degrees, ±

    def sequence(self, seed: int) -> Sequence:
        """The pictures, with exposures that differ by ±15 %."""
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
    PictureSet("4x3 views, λ = -0.25", (640, 480), (4, 3), 520.0, -0.25, (2.5, -2.0), 8.0),
    PictureSet("6x2 views, λ = -0.25", (800, 600), (6, 2), 650.0, -0.25, (2.0, -1.5), 8.0),
    PictureSet("4x3 views, λ = -0.45", (640, 480), (4, 3), 420.0, -0.45, (-6.0, 5.0), 15.0),
    PictureSet("4x3 views, λ = 0", (640, 480), (4, 3), 520.0, 0.0, (0.0, 0.0), 180.0),
)
_TINY = PictureSet("2x1 views", (320, 240), (2, 1), 260.0, -0.25, (2.5, -2.0), 8.0)


def run(settings: Settings) -> Report:
    """Registration error, coverage, λ, time, memory and exit status of every stitcher that is installed."""
    stitchers, notes = installed_stitchers(settings.peer_python)
    if settings.effort is Effort.TINY:
        chosen, stitchers = [_TINY], stitchers[:2]
    else:
        chosen = list(SETS[: settings.count(1, 1, len(SETS))])
    timeout = float(settings.count(60, 120, 600))
    tables, pictures = [], {}
    for number, picture_set in enumerate(chosen):
        with TemporaryDirectory(prefix="rdstitch-peers-") as folder:
            sequence = picture_set.sequence(seed=100 + number)
            files = sequence.write(folder)
            rows = []
            for k, stitcher in enumerate(stitchers):
                own = Path(folder) / f"stitcher{k}"
                own.mkdir()
                row, mosaic = _judge(stitcher, sequence, files, own, picture_set, timeout)
                rows.append(row)
                if mosaic is not None:
                    pictures[f"end_to_end_set{number}_{k}.jpg"] = mosaic[:, :, :3] if mosaic.ndim == 3 else mosaic
        title = f"End to end: {picture_set.name}, {picture_set.size[0]}x{picture_set.size[1]} px"
        tables.append(Table(title, HEADER, tuple(rows)))
    return Report(tuple(tables), pictures=pictures, notes=notes)


def _judge(
    stitcher: Stitcher, sequence: Sequence, files: list[Path], folder: Path, picture_set: PictureSet, timeout: float
) -> tuple[tuple[object, ...], Pixels | None]:
    """One row of the table, and the mosaic."""
    output = folder / "mosaic.tif"
    done = run_all(stitcher.commands(files, output, picture_set.field_of_view), folder, timeout)
    mosaic = read_mosaic(folder) if done.ok else None
    found = None if mosaic is None else _compared(mosaic, sequence)
    return (stitcher.name, *row_of(done, found, distortion_error_of(output, sequence))), mosaic


def row_of(done: Run, found: PlaneComparison | None, distortion_error: float | None) -> tuple[object, ...]:
    """Errors are given in px of the pictures, for mosaics of any scale."""
    status = "time is up" if done.status is None else str(done.status)
    cost = (done.seconds, done.processor_seconds, done.megabytes, "" if done.ok else done.said)
    if found is None:
        return status, None, None, None, distortion_error, *cost
    return (
        status,
        _in_pictures(found.median, found),
        _in_pictures(found.percentile95, found),
        100.0 * found.coverage,
        distortion_error,
        *cost,
    )


def _compared(mosaic: Pixels, sequence: Sequence) -> PlaneComparison:
    return compare_with_plane(mosaic, sequence.texture, reachable=sequence.reachable(), search=_SEARCH)


def _in_pictures(error: float, found: PlaneComparison) -> object:
    """An error in px of the mosaic as px of the pictures, or that it is beyond what was searched."""
    return error * found.texels_per_pixel if np.isfinite(error) else f"> {_SEARCH}"


def read_mosaic(folder: Path) -> Pixels | None:
    """What the stitcher wrote; RGB or grey, with alpha where it has one."""
    written = sorted(folder.glob("mosaic*.tif")) + sorted(folder.glob("mosaic*.jpg"))
    if not written:
        return None
    picture: Any = read_image(written[0])
    pixels = np.asarray(picture.pixels)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if picture.alpha is None:
        return pixels
    colours = pixels if pixels.ndim == 3 else np.repeat(pixels[:, :, None], 3, axis=2)
    alpha = (np.asarray(picture.alpha) > 0).astype(np.uint8) * np.uint8(255)
    return np.concatenate([colours, alpha[:, :, None]], axis=2)


def distortion_error_of(output: Path, sequence: Sequence) -> float | None:
    """|λ - λ_true| where the stitcher has told its λ."""
    told = Path(f"{output}.json")
    if not told.is_file() or not isinstance(sequence.lens, Camera):
        return None
    content = json.loads(told.read_text(encoding="utf-8"))
    return abs(float(content["lambda"]) - sequence.lens.distortion)
