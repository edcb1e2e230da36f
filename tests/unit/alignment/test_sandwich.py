"""The standard deviation of λ covers its error also where errors are no independent noise."""

import numpy as np
import pytest

from rdstitch.alignment import AlignmentOptions, align
from tests.alignment_scenes import grid, scene


@pytest.mark.parametrize("relief", [0.0, 0.03])
def test_the_stated_deviation_covers_relief(relief: float) -> None:
    misses = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        given = scene(grid(3, 2, (0.4, 0.3), 0.2, rng), rng=rng, relief=relief)
        found = align(given.cameras, given.links, AlignmentOptions(model="similarity"))
        misses.append(abs(found.distortion - given.distortion) / found.distortion_std)
    assert max(misses) < 3.0
    assert np.median(misses) > 0.05
