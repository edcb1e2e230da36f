"""kill -9 measured: ``python -m examples.benchmarks.interruptions``.

Frames of a robot's drive are registered with ``--cache``; the process is killed at random moments, and the next run
goes on from the cache. Printed is how much of the work was begun more than once, by the processor time that it takes,
and whether the result has the same bytes.
"""

import os

from examples.benchmarks.driver import run
from tests.interrupted_runs import repeated


def main(*, frames: int = 300, kills: int = 10, seed: int = 0) -> None:
    """Print what was done again."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    shares, same = repeated(frames, kills, seed)
    names = {"_detect": "detected", "_match_signs": "matched", "estimate_radial_homographies": "estimated"}
    for kind, share in shares.items():
        print(f"{names.get(kind, kind):10s}{100 * share:6.1f} % again")
    print("the same bytes" if same else "OTHER BYTES")


if __name__ == "__main__":
    run(main)
