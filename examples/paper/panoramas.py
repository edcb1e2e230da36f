"""Panoramas end to end: rendered turns on the spot stitched by rdstitch and by the peers, laid on the true sphere."""

import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from examples.judging import SphereComparison, compare_with_sphere
from examples.paper.common.report import Pixels, Report, Table
from examples.paper.common.settings import Effort, Settings
from examples.paper.common.stitchers import Stitcher, installed_panorama_stitchers
from examples.paper.common.subprocesses import run_all
from examples.paper.end_to_end import HEADER, distortion_error_of, read_mosaic
from rdstitch.camera import Camera
from rdstitch.synthetic import Photometry, TurningSequence, panorama_rotations, turning_sequence

_SEARCH = 16  # px of the panorama about each of its places, within which the place is looked for on the sphere


@dataclass(frozen=True)
class TurnSet:
    """A turn on the spot, to be rendered: pictures of 640 x 480 with an angle of view of 60 degrees."""

    name: str
    count: int
    step: float  # degrees
    rows: int
    distortion: float
    size: tuple[int, int] = (640, 480)

    @property
    def focal(self) -> float:
        """Pixels."""
        return 554.0 * self.size[0] / 640

    def sequence(self, seed: int) -> TurningSequence:
        """The pictures, held by hand: off by up to 3 degrees, with exposures that differ by 15 %."""
        lens = Camera(self.size, self.distortion, focal=self.focal, focal_source="option")
        rotations = panorama_rotations(
            self.count, math.radians(self.step), rows=self.rows, jitter=math.radians(3.0), seed=seed
        )
        gain = np.random.default_rng(seed).uniform(0.85, 1.15, len(rotations))
        return turning_sequence(lens, rotations, seed=seed, photometry=Photometry(gain=gain, noise=0.008, blur=0.5))


SETS = (
    TurnSet("3 pictures, λ = -0.2", 3, 25.0, 1, -0.2),
    TurnSet("6 pictures, λ = -0.45", 6, 25.0, 1, -0.45),
    TurnSet("13 pictures all the way round, λ = -0.2", 13, 360.0 / 13, 1, -0.2),
    TurnSet("13 pictures all the way round, λ = 0", 13, 360.0 / 13, 1, 0.0),
    TurnSet("two rows of 13, λ = -0.2", 13, 360.0 / 13, 2, -0.2),
)
_TINY = TurnSet("2 pictures", 2, 25.0, 1, -0.2, (320, 240))


def run(settings: Settings) -> Report:
    """Error, coverage, λ, time, memory and exit status of every stitcher that is installed."""
    stitchers, notes = installed_panorama_stitchers(settings.peer_python)
    if settings.effort is Effort.TINY:
        chosen, stitchers = [_TINY], stitchers[:2]
    else:
        chosen = list(SETS[: settings.count(1, 2, len(SETS))])
    timeout = float(settings.count(60, 120, 600))
    tables, pictures = [], {}
    for number, turn in enumerate(chosen):
        with TemporaryDirectory(prefix="rdstitch-peers-") as folder:
            sequence = turn.sequence(seed=300 + number)
            files = sequence.write(folder)
            rows = []
            for k, stitcher in enumerate(stitchers):
                own = Path(folder) / f"stitcher{k}"
                own.mkdir()
                row, panorama = _judge(stitcher, sequence, files, own, turn, timeout)
                rows.append(row)
                if panorama is not None:
                    pictures[f"panoramas_set{number}_{k}.jpg"] = panorama[:, :, :3] if panorama.ndim == 3 else panorama
        tables.append(Table(f"Panoramas: {turn.name}", HEADER, tuple(rows)))
    return Report(tuple(tables), pictures=pictures, notes=notes)


def _judge(
    stitcher: Stitcher, sequence: TurningSequence, files: list[Path], folder: Path, turn: TurnSet, timeout: float
) -> tuple[tuple[object, ...], Pixels | None]:
    """One row of the table, and the panorama."""
    output = folder / "mosaic.tif"
    angle = math.degrees(2.0 * math.atan(turn.size[0] / 2.0 / turn.focal))
    done = run_all(stitcher.commands(files, output, angle), folder, timeout)
    panorama = read_mosaic(folder) if done.ok else None
    found = None if panorama is None else compare_with_sphere(panorama, sequence, _SEARCH)
    status = "time is up" if done.status is None else str(done.status)
    cost = (done.seconds, done.processor_seconds, done.megabytes, "" if done.ok else done.said)
    measured = (None, None, None) if found is None else _measured(found, turn)
    return (stitcher.name, status, *measured, distortion_error_of(output, sequence), *cost), panorama


def _measured(found: SphereComparison, turn: TurnSet) -> tuple[object, object, float]:
    """Median error and 95 %, in px of the pictures, and coverage, %."""
    errors = (found.quantile(share) * turn.focal for share in (0.5, 0.95))
    median, most = (error if np.isfinite(error) else f"> {_SEARCH}" for error in errors)
    return median, most, 100.0 * found.coverage
