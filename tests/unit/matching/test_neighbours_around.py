"""Pairs of images from one centre that overlap: those that all pairs would give, without looking at all of them."""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rdstitch.camera import Camera
from rdstitch.matching import neighbours_around as module
from rdstitch.matching.neighbours_around import neighbours_around


@pytest.mark.parametrize("distortion", [-0.9, -0.2, 0.0, 0.05])
@pytest.mark.parametrize("focal", [0.4, 1.0, 4.0])
def test_the_same_as_of_all_pairs(distortion: float, focal: float) -> None:
    cameras = [Camera(size, distortion=distortion) for size in ((640, 480), (480, 640)) * 15]
    turned = Rotation.random(30, rng=np.random.default_rng(3)).as_matrix()
    directions = turned @ np.diag([1.0, 1.0, focal])
    directions[7] = np.nan
    known = [k for k in range(30) if k != 7]
    rays = {k: module._rays(cameras[k], directions[k]) for k in known}
    back = {k: np.linalg.inv(directions[k]) for k in known}

    def overlap(i: int, j: int) -> bool:
        shares = [module._share_seen(rays[a], cameras[b], back[b]) for a, b in ((i, j), (j, i))]
        return max(shares) >= module._MIN_OVERLAP

    expected = [pair for pair in combinations(known, 2) if overlap(*pair)]
    assert neighbours_around(cameras, directions, set()) == expected
    assert neighbours_around(cameras, directions, set(expected[::2])) == expected[1::2]


def test_of_a_full_circle_few_pairs_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    count = 200
    cameras = [Camera((640, 480))] * count
    turned = Rotation.from_rotvec(np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)[:, None] * [0, 1, 0]).as_matrix()
    looked: list[int] = []
    share = module._share_seen

    def counted(*given: object) -> float:
        looked.append(1)
        return share(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "_share_seen", counted)
    found = neighbours_around(cameras, turned @ np.diag([1.0, 1.0, 3.0]), set())
    assert len(found) >= 10 * count
    assert len(looked) < 2 * 0.25 * count * (count - 1) / 2
