"""Fewer correspondences, evenly spread."""

import numpy as np

from rdstitch.matching.thinning import spread_choice


def test_thinning_keeps_the_overlap_covered() -> None:
    rng = np.random.default_rng(0)
    crowd = rng.normal(0.2, 0.01, (900, 2))
    spread = rng.uniform(-1, 1, (100, 2))
    points = np.concatenate([crowd, spread])
    kept = spread_choice(points, 100)
    assert len(kept) == 100
    assert len(np.unique(kept)) == 100
    assert (kept >= 900).sum() > 60
    assert (spread_choice(points[:7], 100) == np.arange(7)).all()


def test_each_cell_gives_one_before_any_gives_two() -> None:
    rng = np.random.default_rng(1)
    # Ten in each of the nine cells of a grid of three by three, but two in the last.
    cells = np.repeat(np.stack(np.meshgrid(range(3), range(3)), axis=-1).reshape(-1, 2), 10, axis=0)[:82]
    points = (cells + rng.uniform(0.2, 0.8, cells.shape)) / 3.0
    points[0], points[-1] = 0.0, 1.0
    # Of each cell the first; then the second of the first one. The point on the border is in the last cell.
    assert spread_choice(points, 9).tolist() == [0, 10, 20, 30, 40, 50, 60, 70, 80]
    assert spread_choice(points, 10).tolist() == [0, 1, 10, 20, 30, 40, 50, 60, 70, 80]
