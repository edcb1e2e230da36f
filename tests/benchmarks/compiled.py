"""What a compiled kernel would gain: ``python -m tests.benchmarks.compiled`` (with ``pip install numba``).

The linearization of the alignment, the largest stage that is written in Python, as NumPy has it and as one loop that
Numba compiles: times, what compiling costs every process, and how much the numbers differ. Nothing of rdstitch uses it.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from examples.paper.common.peers import optional_module
from rdstitch.alignment.link_equations import link_equations
from rdstitch.alignment.observations import Observations
from rdstitch.arrays import FloatArray
from tests.alignment_scenes import grid, scene

_ROUNDS = 15
_WIDTH = 3.0  # pixels, of the robust loss
_FREE = np.arange(5) == 0  # λ alone


def linearize(
    start: Any, x1: Any, x2: Any, scale2: Any, homographies: Any, distortion: float, width: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gram matrices and gradients by H and λ (10 entries), and squared whitened errors, of images of one size."""
    count = len(start) - 1
    gram, gradient, squared = np.zeros((count, 10, 10)), np.zeros((count, 10)), np.empty(len(x1))
    # Written out, since products of small matrices are calls of a library also where they are compiled.
    by_z, by_point, z, point, column = np.empty((2, 3)), np.empty((2, 3)), np.empty(3), np.empty(3), np.empty((2, 10))
    for link in range(count):
        h = homographies[link]
        for m in range(start[link], start[link + 1]):
            r2 = x1[m, 0] ** 2 + x1[m, 1] ** 2
            point[0], point[1], point[2] = x1[m, 0], x1[m, 1], 1.0 + distortion * r2
            for i in range(3):
                z[i] = h[i, 0] * point[0] + h[i, 1] * point[1] + h[i, 2] * point[2]
            u, v = z[0] / z[2], z[1] / z[2]
            root = 1.0 - 4.0 * distortion * (u * u + v * v)
            if z[2] <= 0.0 or root <= 0.0:
                squared[m] = np.inf
                continue
            ratio = 2.0 / (1.0 + np.sqrt(root))
            dx, dy = u * ratio, v * ratio
            rho2 = dx * dx + dy * dy
            g, k = 1.0 + distortion * rho2, 1.0 - distortion * rho2
            bend = 2.0 * distortion / k
            xx, xy, yy = g * (1.0 + bend * dx * dx), g * bend * dx * dy, g * (1.0 + bend * dy * dy)
            by_z[0, 0], by_z[0, 1], by_z[0, 2] = xx / z[2], xy / z[2], -(xx * u + xy * v) / z[2]
            by_z[1, 0], by_z[1, 1], by_z[1, 2] = xy / z[2], yy / z[2], -(xy * u + yy * v) / z[2]
            for axis in range(2):
                for i in range(3):
                    by_point[axis, i] = by_z[axis, 0] * h[0, i] + by_z[axis, 1] * h[1, i] + by_z[axis, 2] * h[2, i]
                    for j in range(3):
                        column[axis, 3 * i + j] = by_z[axis, i] * point[j]
                for i in range(2):
                    by_point[axis, i] += by_point[axis, 2] * 2.0 * distortion * x1[m, i]
            column[0, 9] = by_point[0, 2] * r2 + dx * rho2 / k
            column[1, 9] = by_point[1, 2] * r2 + dy * rho2 / k
            sxx = 1.0 + by_point[0, 0] ** 2 + by_point[0, 1] ** 2
            syy = 1.0 + by_point[1, 0] ** 2 + by_point[1, 1] ** 2
            sxy = by_point[0, 0] * by_point[1, 0] + by_point[0, 1] * by_point[1, 1]
            scale = 2.0 * scale2[link] ** 2 / (sxx * syy - sxy * sxy)
            pxx, pxy, pyy = syy * scale, -sxy * scale, sxx * scale
            ex, ey = dx - x2[m, 0], dy - x2[m, 1]
            squared[m] = ex * (pxx * ex + 2.0 * pxy * ey) + pyy * ey * ey
            weight = (1.0 / (1.0 + squared[m] / width**2)) ** 2
            for i in range(10):
                left = weight * (pxx * column[0, i] + pxy * column[1, i])
                down = weight * (pxy * column[0, i] + pyy * column[1, i])
                gradient[link, i] += left * ex + down * ey
                for j in range(i + 1):
                    gram[link, i, j] += left * column[0, j] + down * column[1, j]
        for i in range(10):
            for j in range(i):
                gram[link, j, i] = gram[link, i, j]
    return gram, gradient, squared


def _milliseconds(work: Callable[[], Any]) -> float:
    """Median processor time."""
    taken = []
    for _ in range(_ROUNDS):
        begun = time.process_time()
        work()
        taken.append(time.process_time() - begun)
    return 1e3 * float(np.median(taken))


def main() -> None:
    """Print the comparison for sets of two sizes."""
    begun = time.process_time()
    numba = optional_module("numba")
    if numba is None:
        print("numba is not installed (pip install numba)")
        return
    print(f"import of numba {time.process_time() - begun:.2f} s")
    compiled = numba.njit(linearize)
    for columns, rows in ((4, 3), (7, 6)):
        poses = grid(columns, rows, (0.3, 0.3), 0.2, np.random.default_rng(1))
        truth = scene(poses, per_link=120, rng=np.random.default_rng(2))
        observations = Observations.from_links(truth.links, truth.cameras)
        homographies = np.stack([link.relation.homography for link in truth.links])
        lens = np.array([truth.distortion, 0.0, 0.0, 0.0, 0.0])
        o = observations
        given = (o.start, o.points1, o.points2, o.scale2, homographies, truth.distortion, _WIDTH)
        begun = time.process_time()
        gram, gradient, squared = compiled(*given)
        if columns == 4:
            print(f"compiling {time.process_time() - begun:.2f} s")
        ours = link_equations(observations, homographies, lens, _WIDTH, _FREE)
        np.testing.assert_allclose(squared, ours.squared, rtol=1e-9)
        np.testing.assert_allclose(gram, ours.gram, rtol=1e-6, atol=1e-9 * np.abs(gram).max())
        np.testing.assert_allclose(gradient, ours.gradient, rtol=1e-6, atol=1e-9 * np.abs(gradient).max())
        both = [
            _milliseconds(lambda given=given: compiled(*given)),  # type: ignore[misc]
            _milliseconds(lambda o=o, h=homographies, lens=lens: link_equations(o, h, lens, _WIDTH, _FREE)),  # type: ignore[misc]
        ]
        print(
            f"{len(o)} links, {len(o.points1)} correspondences: NumPy {both[1]:.2f} ms, compiled {both[0]:.2f} ms, "
            f"{both[1] / both[0]:.1f} times"
        )


if __name__ == "__main__":
    main()
