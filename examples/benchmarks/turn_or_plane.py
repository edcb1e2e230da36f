"""Is a turn on the spot told from a move over a plane? ``python -m examples.benchmarks.turn_or_plane [--sets 20]``.

Half of the sets are turns, with and without parallax; half are images of a plane: pairs, chains and grids of a robot
or a drone, and free poses as of a hand or a kite. One line for every set whose kind was not found, and the totals.
"""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from examples.benchmarks.driver import run
from examples.worlds.trust_sets import SOLVABLE, trust_set
from examples.worlds.turns import panorama_rotations, turning_sequence
from rdstitch.errors import RdstitchError
from rdstitch.geometry.camera import Camera
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.recipes import mosaic
from rdstitch.synthetic import Photometry, RenderedSequence, grid_poses, ground, sequence_over

BOTH = "a plane seen from one place would look the same"


def turn(seed: int) -> RenderedSequence:
    """Two to six images of a camera that turns; every third one is held by hand, before things that are near."""
    rng = np.random.default_rng((seed, 5))
    lens = Camera((400, 300), float(rng.uniform(-0.35, 0.05)), focal=float(rng.uniform(0.6, 1.4) * 400.0))
    assert lens.focal is not None
    count, overlap = int(rng.integers(2, 7)), float(rng.uniform(0.4, 0.7))
    step = (1.0 - overlap) * 2.0 * float(np.arctan(200.0 / lens.focal))
    rotations = panorama_rotations(count, step, jitter=0.05, seed=seed)
    ahead = rotations[:, 2]
    by_hand = seed % 3 == 0
    position = (float(rng.uniform(0.005, 0.02)) if by_hand else 0.0) * ahead
    balls = np.column_stack([0.5 * ahead, np.full(count, 0.06)])
    look = Photometry(float(rng.uniform(0.8, 1.1)), float(rng.uniform(0.0, 0.3)), noise=0.012)
    return turning_sequence(
        lens, rotations, seed=seed, photometry=look, position=position, near=balls if by_hand else ()
    )


def plane(seed: int) -> RenderedSequence:
    """A set of :mod:`examples.worlds.trust_sets`, or images with tilts and heights of their own."""
    rng = np.random.default_rng((seed, 6))
    kind = str(rng.choice([*SOLVABLE, "free"]))
    if kind != "free":
        return trust_set(seed, kind).sequence
    lens = Camera((400, 300), float(rng.uniform(-0.35, 0.05)), focal=float(rng.uniform(0.8, 1.6) * 400.0))
    poses = grid_poses(lens, 3, 2, overlap=0.55, yaw=0.3, shift=0.05, seed=seed)
    poses = poses.shaken(seed=seed, height=0.15, tilt=float(rng.uniform(0.05, 0.3)))
    return sequence_over(lambda size: ground(size, seed), lens, poses, photometry=Photometry(noise=0.012), seed=seed)


def main(*, sets: int = 20, first: int = 0) -> None:
    """Print what was not found, and the totals."""
    right = both = refused = 0
    parallax = {True: [0, 0], False: [0, 0]}
    start = time.process_time()
    for seed in range(first, first + sets):
        turns = seed % 2 == 1
        with TemporaryDirectory() as folder:
            paths = (turn if turns else plane)(seed).write(Path(folder))
            try:
                registration = mosaic(paths, options=StitchOptions(workers=1)).registration
            except RdstitchError as refusal:
                refused += 1
                print(f"{seed} {'turn' if turns else 'plane'}: refused: {refusal}", flush=True)
                continue
        alignment = registration.alignment
        found, either = alignment.on_sphere, BOTH in alignment.model_reason
        right += found == turns
        both += found != turns and either
        if turns:
            parallax[seed % 3 == 0][any(m.code == "parallax" for m in registration.messages)] += 1
        if found != turns:
            text = f"{alignment.model}, {len(paths)} images, rms {alignment.rms:.2f}: {alignment.model_reason}"
            print(f"{seed} {'turn' if turns else 'plane'}: {text}", flush=True)
    print(
        f"{right} of {sets} sets right, {both} more said that both explain the images, {refused} refused; "
        f"parallax: {parallax[True][1]} of {sum(parallax[True])} turns by hand, {parallax[False][1]} of "
        f"{sum(parallax[False])} others; {(time.process_time() - start) / sets:.1f} s a set"
    )


if __name__ == "__main__":
    run(main)
