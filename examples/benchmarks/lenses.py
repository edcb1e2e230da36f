"""Rendered sets through fisheyes, Brown lenses and one-parameter lenses: ``python -m examples.benchmarks.lenses``.

For each set the lens that was chosen, λ, and the distance from the true plane after the best similarity, pixels of the
images: with the ladder of lenses, and with λ alone. At the end, for each kind of lens, the share of the sets in which
the ladder stopped at its first rung, the medians over the sets, and the worst set.

"random fisheye", "random Brown" and "random one parameter" are another lens in each set, all but the last with a centre
that is off by up to 5 % of width and height.
"""

import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from examples.benchmarks.driver import run
from examples.judging import registration_error
from rdstitch.choices import LensName
from rdstitch.errors import RdstitchError
from rdstitch.executors import open_executor
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.source import read_sources
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.registration.register import register
from rdstitch.pipeline.run import Run
from rdstitch.synthetic import BrownLens, FisheyeLens, RenderedSequence, grid_poses, ground, sequence_over
from rdstitch.synthetic.lenses import Lens

NAMES = ("fisheye 90", "fisheye 120", "fisheye 140", "phone", "action camera", "one parameter")
_FISHEYES = {90: (0.0, 0.0), 120: (0.05, -0.03), 140: (-0.02, 0.05)}
_BROWN = {  # focal length in half diagonals, k1, k2, k3, p1, p2, and the offset in shares of width and height
    "phone": ((1.5, 0.08, -0.15, 0.08, 0.0005, -0.0004), (0.0125, -0.0125)),
    "action camera": ((1.1, -0.26, 0.09, -0.015, 0.0003, 0.0005), (0.03125, 0.0208)),
}


def lens_of(name: str, seed: int, size: tuple[int, int]) -> Lens:
    """The lens of one set."""
    if name in _BROWN:
        return _brown(*_BROWN[name], size)
    if name == "one parameter":
        return Camera(size, -0.2, focal=0.8125 * size[0], focal_source="option")
    if name.startswith("fisheye "):
        view = int(name.removeprefix("fisheye "))
        return _fisheye("equidistant", view, _FISHEYES[view], size)
    rng = np.random.default_rng(seed)
    offset = tuple(rng.uniform(-0.05, 0.05, 2).tolist())
    if name == "random fisheye":
        kind = ("equidistant", "equisolid", "stereographic")[seed % 3]
        return _fisheye(kind, float(rng.uniform(80, 145)), offset, size)
    if name == "random Brown":
        k1 = float(rng.uniform(-0.3, 0.1))
        k2 = float(0.9 * k1**2 + rng.uniform(-0.03, 0.03))
        tangential = rng.uniform(-0.0005, 0.0005, 2).tolist()
        return _brown((float(rng.uniform(1.1, 1.6)), k1, k2, 0.0, *tangential), offset, size)
    focal = float(rng.uniform(0.6, 1.1)) * size[0]
    return Camera(size, float(rng.uniform(-0.45, 0.1)), focal=focal, focal_source="option")


def _fisheye(kind: str, view: float, offset: tuple[float, ...], size: tuple[int, int]) -> Lens:
    """Of ``view`` degrees from corner to corner."""
    half, angle = float(np.hypot(*size)) / 2.0, np.radians(view / 2.0)
    radius = {"equidistant": angle, "equisolid": 2.0 * np.sin(angle / 2.0), "stereographic": 2.0 * np.tan(angle / 2.0)}
    return FisheyeLens(size, half / radius[kind], offset=(offset[0] * size[0], offset[1] * size[1]), kind=kind)


def _brown(values: tuple[float, ...], offset: tuple[float, ...], size: tuple[int, int]) -> Lens:
    half = float(np.hypot(*size)) / 2.0
    return BrownLens(size, values[0] * half, *values[1:], offset=(offset[0] * size[0], offset[1] * size[1]))


@dataclass(frozen=True)
class Figures:
    """Of one set: the lens found, and the distance from the true plane, pixels: median and 95 %."""

    lens: str
    median: float
    percentile95: float


def measure(name: str, seed: int, chosen: LensName, files: list[Path], sequence: RenderedSequence) -> Figures:
    """One set through the registration, with a line of its own."""
    start = time.process_time()
    sources, _ = read_sources(files, camera=None, focal=None, distortion=None, skip_bad=False)
    with open_executor(1, len(sources)) as executor:
        options = StitchOptions(lens=chosen, workers=1)
        found = register(sources, Run(options), executor).alignment
    error = registration_error(found, sequence, "similarity")
    print(
        f"{name:20s} {seed:3d} {chosen:9s} {found.lens:16s} λ {found.distortion:+.4f} ± "
        f"{found.distortion_std:.4f}  {found.model:10s} {int(found.used.sum())} images  "
        f"median {error.median:.3f}  95 % {error.percentile95:.3f}  largest {error.max:.3f}  "
        f"{time.process_time() - start:.0f} s",
        flush=True,
    )
    return Figures(found.lens, error.median, error.percentile95)


def summary(name: str, chosen: str, found: list[Figures]) -> str:
    """One line for a kind of lens."""
    first = sum(figures.lens == "division" for figures in found)
    median, percentile95 = ([getattr(f, part) for f in found] for part in ("median", "percentile95"))
    return (
        f"{name:20s} {chosen:9s} {len(found)} sets, {first} at the first rung; median {np.median(median):.3f} "
        f"(worst {max(median):.3f}), 95 % {np.median(percentile95):.3f} (worst {max(percentile95):.3f})"
    )


def main(
    names: tuple[str, ...] = NAMES,
    *,
    seeds: int = 1,
    first: int = 0,
    lens: tuple[LensName, ...] = ("auto", "division"),
    width: int = 640,
) -> None:
    """Print the table."""
    size = (width, width * 3 // 4)
    results: dict[tuple[str, str], list[Figures]] = {}
    for name in names:
        for seed in range(first, first + seeds):
            camera = lens_of(name, seed, size)
            poses = grid_poses(camera, 4, 3, overlap=0.5, yaw=np.pi, shift=0.05, tilt=(0.05, -0.03), seed=seed)
            sequence = sequence_over(partial(ground, seed=seed, channels=1), camera, poses)
            with tempfile.TemporaryDirectory() as folder:
                files = sequence.write(folder)
                for chosen in lens:
                    try:
                        found = measure(name, seed, chosen, files, sequence)
                        results.setdefault((name, chosen), []).append(found)
                    except RdstitchError as error:
                        print(f"{name:20s} {seed:3d} {chosen:9s} {error}", flush=True)
    for key, figures in results.items():
        print(summary(*key, figures))


if __name__ == "__main__":
    run(main)
