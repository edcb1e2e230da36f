"""The minimal solvers that the figures compare, each applied to the first points of the same instances."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from examples.paper.common.peers import homlib_solver
from rdstitch import solvers
from rdstitch.arrays import FloatArray
from rdstitch.solvers import Solutions
from tests.instances import PlanarInstances

HOMLIB: tuple[tuple[str, str, tuple[bool, ...]], ...] = (
    ("5 points, Fitzgibbon (homlib)", "estimate_fitzgibbon_cvpr_2001_two_sided_equal", ()),
    ("5 points, Wadenbäck (homlib)", "estimate_wadenback_3dv_2026_two_sided_equal", (False,)),
)
"""Solvers of homlib for one λ in both images: name, function, further arguments."""


@dataclass(frozen=True)
class Contender:
    """A minimal solver.

    ``solve``: takes the points of the instances (B, points, 2), both images, and their true tilts (B, 2), which only
    solvers for a known tilt look at.
    """

    name: str
    points: int  # correspondences that it needs
    solve: Callable[[FloatArray, FloatArray, FloatArray], Solutions]

    def __call__(self, instances: PlanarInstances) -> Solutions:
        """Solve all instances."""
        k = self.points
        return self.solve(instances.x1[:, :k], instances.x2[:, :k], instances.tilt)


def known_tilt() -> list[Contender]:
    """Solvers that are told the tilt."""
    return [
        Contender("2 points", 2, lambda a, b, tilt: solvers.two_point(a, b, _per_image(tilt))),
        Contender(
            "3 points, height free", 3, lambda a, b, tilt: solvers.three_point_similarity(a, b, _per_image(tilt))
        ),
    ]


def own_unknown_tilt() -> list[Contender]:
    """Our solvers that are not told the tilt."""
    return [
        Contender("3 points", 3, lambda a, b, _: solvers.three_point(a, b)),
        Contender("4 points", 4, lambda a, b, _: solvers.four_point(a, b)),
        Contender("5 points", 5, lambda a, b, _: solvers.five_point(a, b)),
    ]


def homlib_contenders() -> list[Contender]:
    """Solvers of homlib; none where it is not installed."""
    found = []
    for name, function, arguments in HOMLIB:
        solve = homlib_solver(function, *arguments)
        if solve is not None:
            found.append(Contender(name, 5, lambda a, b, _, solve=solve: solve(a, b)))  # type: ignore[misc]
    return found


def unknown_tilt() -> list[Contender]:
    """Solvers that are not told the tilt, ours and, where it is installed, homlib's."""
    return own_unknown_tilt() + homlib_contenders()


def _per_image(tilt: FloatArray) -> FloatArray:
    """The same tilt (B, 2) for both images of a sample; shape (B, 2, 2)."""
    return np.repeat(tilt[:, None, :], 2, axis=1)
