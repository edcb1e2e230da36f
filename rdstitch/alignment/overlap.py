"""How much images that are aligned overlap."""

import numpy as np

from rdstitch.alignment.result import Alignment
from rdstitch.geometry.camera import points_over

_GRID = 24  # points a side by which an overlap is measured


def median_overlap(alignment: Alignment) -> float | None:
    """Median over the images of the largest share that another one shows too; None where none overlap."""
    best = np.zeros(len(alignment.used))
    for fit in (fit for fit in alignment.links if fit.used):
        for first, second in ((fit.image1, fit.image2), (fit.image2, fit.image1)):
            size, other = alignment.cameras[first].image_size, alignment.cameras[second].image_size
            with np.errstate(invalid="ignore"):
                moved = alignment.transfer(first, second, points_over(size, _GRID))
                inside = ((moved >= -0.5) & (moved < np.array(other) - 0.5)).all(axis=1)
            best[first] = max(best[first], inside.mean())
    return float(np.median(best[best > 0])) if (best > 0).any() else None
