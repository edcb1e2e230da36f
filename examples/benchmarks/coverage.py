"""Is λ's standard deviation honest? ``python -m examples.benchmarks.coverage FOLDER=λ...``.

Windows of images that follow one another, at random places of folders whose λ is known, are calibrated each on its
own. Printed are λ of each, its standard deviation and error in standard deviations, and in the end the share within
three and the median. ``python -m examples.benchmarks.relief`` prints the same for rendered ground, flat and rough.

λ is that of the one-parameter lens nearest over the whole image. A λ fitted to the corners of a chessboard, which do
not reach the corners of the image, is another one: of a GoPro -0.545 there and -0.594 in the whole.
"""

import math
import time
from pathlib import Path

import numpy as np

import rdstitch
from examples.benchmarks.driver import images_of, run
from rdstitch.errors import RdstitchError


def main(folders: tuple[str, ...], *, windows: int = 2, sizes: tuple[int, ...] = (2, 4, 8), seed: int = 0) -> None:
    """Print a line for every window."""
    ratios: list[float] = []
    refused = 0
    for named in folders:
        folder, truth = Path(named.rpartition("=")[0]), float(named.rpartition("=")[2])
        files = images_of(folder)
        rng = np.random.default_rng(seed)
        for size in sizes:
            for first in rng.integers(0, len(files) - size + 1, windows).tolist():
                start = time.process_time()
                try:
                    registration = rdstitch.calibrate(files[first : first + size], rdstitch.StitchOptions(workers=1))
                except RdstitchError as error:
                    refused += 1
                    print(f"{folder.name} {first}+{size}: refused: {str(error)[:100]}", flush=True)
                    continue
                found = registration.alignment
                if not math.isfinite(found.distortion_std):
                    print(f"{folder.name} {first}+{size}: λ is not observable", flush=True)
                    continue
                ratio = abs(found.distortion - truth) / found.distortion_std
                ratios.append(ratio)
                print(
                    f"{folder.name} {first}+{size}: λ = {found.distortion:.4f} ± {found.distortion_std:.4f} "
                    f"({found.lens}), {ratio:.2f} σ from the truth, {time.process_time() - start:.1f} s",
                    flush=True,
                )
    known = np.array(ratios)
    print(
        f"{len(known)} windows, {refused} refused: {np.mean(known <= 3):.0%} within 3 σ, median {np.median(known):.2f}"
    )


if __name__ == "__main__":
    run(main)
