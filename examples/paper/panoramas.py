"""Panoramas end to end: rendered turns on the spot stitched by rdstitch and by the peers, laid on the true sphere."""

import math
from dataclasses import dataclass

import numpy as np

from examples.judging import compare_with_sphere
from examples.paper.common.report import Effort, Pixels, Report, Settings
from examples.paper.common.stitchers import installed_panorama_stitchers
from examples.paper.end_to_end import SEARCH, Measured, compare
from examples.worlds.turns import TurningSequence, panorama_rotations, turning_sequence
from rdstitch.geometry.camera import Camera
from rdstitch.synthetic import Photometry


@dataclass(frozen=True)
class TurnSet:
    """A turn on the spot, to be rendered: images of 640 x 480 with an angle of view of 60 degrees."""

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

    @property
    def field_of_view(self) -> float:
        """Horizontal, of a lens without distortion, degrees."""
        return math.degrees(2.0 * math.atan(self.size[0] / 2.0 / self.focal))

    def sequence(self, seed: int) -> TurningSequence:
        """The images, held by hand: off by up to 3 degrees, with exposures that differ by 15 %."""
        lens = Camera(self.size, self.distortion, focal=self.focal, focal_source="option")
        rotations = panorama_rotations(
            self.count, math.radians(self.step), rows=self.rows, jitter=math.radians(3.0), seed=seed
        )
        gain = np.random.default_rng(seed).uniform(0.85, 1.15, len(rotations))
        return turning_sequence(lens, rotations, seed=seed, photometry=Photometry(gain=gain, noise=0.008, blur=0.5))


SETS = (
    TurnSet("3 images, λ = -0.2", 3, 25.0, 1, -0.2),
    TurnSet("6 images, λ = -0.45", 6, 25.0, 1, -0.45),
    TurnSet("13 images all the way round, λ = -0.2", 13, 360.0 / 13, 1, -0.2),
    TurnSet("13 images all the way round, λ = 0", 13, 360.0 / 13, 1, 0.0),
    TurnSet("two rows of 13, λ = -0.2", 13, 360.0 / 13, 2, -0.2),
)
_TINY = TurnSet("2 images", 2, 25.0, 1, -0.2, (320, 240))


def run(settings: Settings) -> Report:
    """Error, coverage, λ, time, memory and exit status of every stitcher that is installed."""
    stitchers, notes = installed_panorama_stitchers(settings.peer_python)
    chosen = [_TINY] if settings.effort is Effort.TINY else SETS[: settings.count(1, 2, len(SETS))]
    return compare(settings, "panoramas", chosen, 300, stitchers, notes, _measured)


def _measured(panorama: Pixels, sequence: TurningSequence, turn: TurnSet) -> Measured:
    """Median error and 95 %, in px of the images, and coverage."""
    found = compare_with_sphere(panorama, sequence, SEARCH)
    return found.quantile(0.5) * turn.focal, found.quantile(0.95) * turn.focal, found.coverage
