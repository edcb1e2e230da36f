"""What the constants of two-view estimation do: each halved and doubled, on pairs with known truth and without any.

    python -m tests.benchmarks.constants
    python -m tests.benchmarks.constants --pairs 120

Two sets of pairs: solvable ones (rigid, with a change of height, free; 40 to 300 matches of which 20 to 75 % are wrong;
noise of 0.3 to 1.5 pixels) and hopeless ones, whose matches agree in nothing, or in one small place. A line is a
constant with a value, what it decides, and what comes of it.
"""

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from rdstitch.camera import Camera
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies
from rdstitch.synthetic import correspondences
from rdstitch.synthetic.correspondences import SyntheticMatches

SIZE = (1000, 800)

CONSTANTS: dict[str, tuple[str, ...]] = {
    "robust.model_selection": ("PAIR_WIDTH", "_MIN_NOISE", "_NEAR", "_STEPS", "OBSERVABLE_STD"),
    "robust.ransac": ("_SOLVER_SUCCESS", "_MIN_EXPLORATION", "_NOVELTY", "_FREE_REFINEMENT", "_LOCAL_STEPS"),
    "robust.verification": ("_CELLS_PER_DIAGONAL", "MIN_PLACES", "_MAX_CHANCE"),
    "robust.covariance": ("_CELLS_PER_HALF_DIAGONAL",),
    "robust.levenberg_marquardt": ("PAIR_GAIN", "ROUGH_GAIN", "FIRST_DAMPING"),
}


@dataclass(frozen=True)
class Outcome:
    """What came of all pairs.

    Attributes
    ----------
    solved : float
        Share of the solvable pairs that were registered, and rightly: 95 % of the inliers within the threshold.
    wrong : float
        Share of all pairs that were registered wrongly.
    model : float
        Share of those solved that were taken for the motion that they are.
    error, error95 : float
        Median and 95th percentile of the errors of λ.
    deviations : float
        Root mean square of the errors of λ in their own standard deviations, of which one in twenty is left out.
    milliseconds : float
        Processor time of a pair.
    """

    solved: float
    wrong: float
    model: float
    error: float
    error95: float
    deviations: float
    milliseconds: float

    def __str__(self) -> str:
        """One row."""
        return (
            f"{self.solved:8.1%} {self.wrong:7.1%} {self.model:7.1%} {self.error:9.5f} {self.error95:9.5f} "
            f"{self.deviations:6.2f} {self.milliseconds:6.1f}"
        )


def solvable(count: int) -> list[SyntheticMatches]:
    """Pairs of every kind, from easy to hard."""
    return [
        correspondences(
            (40, 80, 150, 300)[seed % 4],
            seed=seed,
            motion=("rigid", "similarity", "homography")[seed % 3],
            outliers=(0.2, 0.4, 0.6, 0.75)[seed // 3 % 4],
            noise=(0.3, 0.7, 1.5)[seed // 12 % 3],
        )
        for seed in range(count)
    ]


def hopeless(count: int) -> list[PairMatches]:
    """Pairs without any common motion; in every other one, a tenth of the matches agree, all in one place."""
    camera, pairs = Camera(SIZE).with_focal(), []
    for seed in range(count):
        rng = np.random.default_rng((seed, 7))
        first, second = rng.uniform((0, 0), (999, 799), (2, (60, 200, 800)[seed % 3], 2))
        if seed % 2:
            few = max(12, len(first) // 10)
            first[:few] = rng.uniform((400, 300), (430, 330), (few, 2))
            second[:few] = first[:few] + rng.uniform(-200, 200, 2)
        pairs.append(PairMatches(first, second, camera, camera))
    return pairs


def outcome(given: list[SyntheticMatches], without: list[PairMatches]) -> Outcome:
    """Estimate all pairs."""
    pairs = [PairMatches(g.points1, g.points2, g.truth.camera, g.truth.camera2, g.quality) for g in given]
    begin = time.process_time()
    found = estimate_radial_homographies(pairs, EstimationOptions())
    false = estimate_radial_homographies(without, EstimationOptions())
    took = (time.process_time() - begin) / (len(pairs) + len(without))
    solved, wrong, models, errors, deviations = 0, sum(bool(f) for f in false), 0, [], []
    for own, relation in zip(given, found, strict=True):
        if not relation:
            continue
        inside = own.truth.inliers
        off = np.linalg.norm(relation.transfer(own.points1[inside]) - own.truth.transfer(own.points1[inside]), axis=1)
        if not (off < 3.0).mean() >= 0.95:
            wrong += 1
            continue
        solved += 1
        models += relation.model == own.truth.model
        if np.isfinite(relation.distortion_std):
            errors.append(abs(relation.distortion - own.truth.distortion))
            deviations.append(errors[-1] / relation.distortion_std)
    kept = np.sort(deviations)[: max(1, len(deviations) * 19 // 20)]
    return Outcome(
        solved / len(pairs),
        wrong / (len(pairs) + len(without)),
        models / max(solved, 1),
        float(np.median(errors)),
        float(np.quantile(errors, 0.95)),
        float(np.sqrt(np.mean(np.square(kept)))),
        1e3 * took,
    )


@contextmanager
def changed(module: str, name: str, value: float) -> Iterator[None]:
    """A constant with another value."""
    home = import_module(f"rdstitch.{module}")
    before = getattr(home, name)
    setattr(home, name, value)
    try:
        yield
    finally:
        setattr(home, name, before)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.constants", description="What constants do.")
    parser.add_argument("--pairs", type=int, default=72, help="solvable ones, and as many hopeless ones")
    arguments = parser.parse_args()
    given, without = solvable(arguments.pairs), hopeless(arguments.pairs)
    outcome(given[:12], without[:6])  # what is done once
    head = f"{'solved':>8} {'wrong':>7} {'model':>7} {'median':>9} {'95 %':>9} {'rms z':>6} {'ms':>6}"
    print(f"{'constant':54} {'value':>9} {head}")
    print(f"{'as they are':54} {'':>9} {outcome(given, without)}")
    for module, names in CONSTANTS.items():
        for name in names:
            value = getattr(import_module(f"rdstitch.{module}"), name)
            for factor in (0.5, 2.0):
                other = type(value)(value * factor)
                with changed(module, name, other):
                    print(f"{module + '.' + name:54} {other:>9.3g} {outcome(given, without)}", flush=True)


if __name__ == "__main__":
    main()
