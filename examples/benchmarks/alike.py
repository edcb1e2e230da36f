"""Which thresholds tell overlaps that look alike from others: ``python -m examples.benchmarks.alike FOLDER…``.

Every folder is a set that ``mosaic`` stitches rightly. Its overlaps are compared as they were registered, and with one
image a tenth of its diagonal away. A row for each value of a threshold of :class:`rdstitch.verification.limits.Limits`,
the one that is used with a star: cells that an overlap has, the median; the fraction of them that agrees, of all right
overlaps together and of all wrong ones; right overlaps with less than ``max_unlike_fraction``, which would be called
unlike, and wrong ones with as much or more, which would not.
"""

from collections.abc import Iterable
from pathlib import Path
from unittest.mock import patch

import numpy as np

import rdstitch
from examples.benchmarks.driver import images_of, run
from rdstitch.choices import Purpose
from rdstitch.verification.evidence import ResultEvidence
from rdstitch.verification.limits import Limits
from rdstitch.verification.overlap_check import ComparedImages
from rdstitch.verification.photometric_agreement import Agreement, ComparedImage, overlap_agreement

_VALUES = {
    "min_texture": (0.003, 0.006, 0.012, 0.024, 0.048),
    "min_correlation": (0.0, 0.3, 0.4, 0.5, 0.6, 0.7),
    "max_offset": (1.0, 1.5, 2.0, 2.5, 3.0, 4.0),
}
_AWAY = 0.2 * np.array([0.6, 0.8])  # half diagonals

Pairs = list[tuple[ComparedImage, ComparedImage]]


def overlaps(folder: Path, most: int) -> tuple[Pairs, Pairs]:
    """Images of the pairs that a set is put together by, where they belong, and with one of them elsewhere."""
    registration = rdstitch.mosaic(list(map(str, images_of(folder)))).registration
    alignment, images = registration.alignment, ComparedImages(registration.sources, registration.stretch)
    used, elsewhere = ResultEvidence(registration, 0.0, purpose=Purpose.MOSAIC).used, np.eye(3)
    elsewhere[:2, 2] = _AWAY
    right, wrong = [], []
    for fit in used[:: max(1, len(used) // most)]:
        i, j = fit.images
        first, second = (images.placed(k, alignment.cameras[k], alignment.homographies[k]) for k in (i, j))
        right.append((first, second))
        wrong.append((images.placed(i, alignment.cameras[i], alignment.homographies[i] @ elsewhere), second))
    return right, wrong


def _row(name: str, right: Iterable[Agreement], wrong: Iterable[Agreement]) -> str:
    row = f"{name:22s}"
    for which, compared in (("right", right), ("wrong", wrong)):
        known = [(each, fraction) for each in compared if (fraction := each.confirming_fraction) is not None]
        cells = sum(each.cells for each, _ in known)
        unlike = [fraction < Limits.max_unlike_fraction for _, fraction in known]
        agree, missed = sum(each.confirming for each, _ in known) / max(cells, 1), sum(unlike)
        missed = missed if which == "right" else len(known) - missed
        row += f"{len(known):6d}{np.median([each.cells for each, _ in known] or [0]):7.0f}{agree:8.1%}{missed:6d}"
    return row


def main(folders: tuple[Path, ...], *, most: int = 20) -> None:
    """Print a row a value, of at most about so many pairs of each set."""
    pairs = [overlaps(folder, most) for folder in folders]
    right, wrong = ([pair for each in pairs for pair in each[k]] for k in (0, 1))
    print(f"{'':22s}" + 2 * " pairs  cells   agree  amiss")
    for name, value in ((name, value) for name, values in _VALUES.items() for value in values):
        used = getattr(Limits, name) == value
        with patch.object(Limits, name, value):
            compared = ([overlap_agreement(*pair) for pair in each] for each in (right, wrong))
            print(_row(f"{name} {value:g}{' *' if used else ''}", *compared), flush=True)


if __name__ == "__main__":
    run(main)
