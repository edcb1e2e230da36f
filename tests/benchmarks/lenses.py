"""Rendered sets through fisheyes, Brown lenses and one-parameter lenses: ``python -m tests.benchmarks.lenses``.

For each set the lens that was chosen, λ, and the distance from the true plane after the best similarity, pixels of the
pictures: with the ladder of lenses, and with λ alone.
"""

import argparse
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

from examples.judging import AlignmentError, alignment_error
from rdstitch.alignment import Alignment
from rdstitch.camera import Camera
from rdstitch.executors import open_executor
from rdstitch.inputs.source import read_sources
from rdstitch.options import StitchOptions
from rdstitch.pipeline.register import register
from rdstitch.radial_homography import to_plane
from rdstitch.synthetic import (
    BrownLens,
    FisheyeLens,
    Sequence,
    grid_poses,
    ground,
    sequence_over,
)
from rdstitch.synthetic.lenses import Lens

SIZE = (640, 480)
_HALF = float(np.hypot(*SIZE)) / 2.0


def _fisheye(view: float, offset: tuple[float, float]) -> Lens:
    """Equidistant, ``view`` degrees from corner to corner, with the centre off by shares of width and height."""
    shift = offset[0] * SIZE[0], offset[1] * SIZE[1]
    return FisheyeLens(SIZE, _HALF / np.radians(view / 2.0), offset=shift)


LENSES: dict[str, Lens] = {
    "fisheye 90": _fisheye(90, (0.0, 0.0)),
    "fisheye 120": _fisheye(120, (0.05, -0.03)),
    "fisheye 140": _fisheye(140, (-0.02, 0.05)),
    "phone": BrownLens(SIZE, 1.5 * _HALF, 0.08, -0.15, 0.08, 0.0005, -0.0004, offset=(8.0, -6.0)),
    "action camera": BrownLens(SIZE, 1.1 * _HALF, -0.26, 0.09, -0.015, 0.0003, 0.0005, offset=(20.0, 10.0)),
    "one parameter": Camera(SIZE, -0.2, focal=520.0, focal_source="option"),
}


def _error(sequence: Sequence, alignment: Alignment) -> AlignmentError:
    used = np.flatnonzero(alignment.used).tolist()
    places = {i: partial(to_plane, alignment.cameras[i], alignment.homographies[i]) for i in used}
    return alignment_error(sequence, places, model="similarity")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(LENSES))
    parser.add_argument("--seeds", type=int, default=1)
    given = parser.parse_args()
    for name in given.names:
        for seed in range(given.seeds):
            lens = LENSES[name]
            poses = grid_poses(lens, 4, 3, overlap=0.5, yaw=np.pi, shift=0.05, tilt=(0.05, -0.03), seed=seed)
            sequence = sequence_over(partial(ground, seed=seed, channels=1), lens, poses)
            with tempfile.TemporaryDirectory() as folder:
                sequence.write(folder)
                files = sorted(Path(folder).iterdir())
                for chosen in ("auto", "division"):
                    start = time.process_time()
                    sources, _ = read_sources(files, camera=None, focal=None, distortion=None, skip_bad=False)
                    with open_executor(1, len(sources)) as executor:
                        registration = register(
                            sources, StitchOptions(lens=chosen, workers=1), executor, skip_bad=False
                        )
                    error = _error(sequence, registration.alignment)
                    found = registration.alignment
                    print(
                        f"{name:14s} {seed} {chosen:9s} {found.lens:16s} λ {found.distortion:+.4f} ± "
                        f"{found.distortion_std:.4f}  {found.model:10s} {int(found.used.sum())} pictures  "
                        f"median {error.median:.3f}  95 % {error.percentile95:.3f}  largest {error.max:.3f}  "
                        f"{time.process_time() - start:.0f} s",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
