"""What holds of every minimal solver: shapes, signs, ranges, and quiet refusal of degenerate samples."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from examples.paper.common.five_point_qep import five_point_qep
from examples.paper.common.rotation_three_point import rotation_three_point
from examples.worlds.instances import lift, planar_instances, rotation_instances
from rdstitch import solvers
from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.planar_motion import PlanarMotion, rotation_from_tilt
from rdstitch.geometry.radial_homography import transfer
from rdstitch.solvers import Solutions

TILT = (0.12, -0.2)


@dataclass(frozen=True)
class Case:
    """A solver with what it needs to know, and how many points it takes."""

    name: str
    count: int
    solve: Callable[..., Solutions]
    exact: bool = True
    """Whether solutions fit all points of the sample."""
    turns: bool = False
    """Whether it is for a camera that turns on the spot."""


CASES = [
    Case("two_point", 2, partial(solvers.two_point, tilt=TILT)),
    Case("three_point", 3, solvers.three_point),
    Case("three_point_similarity", 3, partial(solvers.three_point_similarity, tilt=TILT), exact=False),
    Case("four_point", 4, solvers.four_point),
    Case("five_point", 5, solvers.five_point, exact=False),
    Case("five_point_qep", 5, five_point_qep, exact=False),
    Case("rotation_two_point", 2, solvers.rotation_two_point, turns=True),
    Case("rotation_three_point", 3, rotation_three_point, exact=False, turns=True),
    Case("two_point_rigid", 2, partial(solvers.two_point_rigid, distortion=-0.3, tilt=TILT), exact=False),
    Case("two_point_similarity", 2, partial(solvers.two_point_similarity, distortion=-0.3, tilt=TILT)),
    Case("four_point_dlt", 4, partial(solvers.four_point_dlt, distortion=-0.3)),
    Case("rotation_two_point_focal", 2, partial(solvers.rotation_two_point_focal, distortion=-0.3), turns=True),
]


def cases(chosen: list[Case]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("case", chosen, ids=lambda case: case.name)


def samples(case: Case, batch: int = 300, noise: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Points of planar motions with the tilt and the λ that the cases know, or of rotations with that λ."""
    if case.turns:
        turned = rotation_instances(batch, case.count, seed=7, distortion=(-0.3, -0.3), noise=noise)
        return turned.x1, turned.x2
    instances = planar_instances(batch, case.count, seed=7, distortion=(-0.3, -0.3), max_tilt=0.0, noise=noise)
    if case.count == 2:
        return tilted(instances.x1), tilted(instances.x2)
    return instances.x1, instances.x2


def tilted(points: FloatArray) -> FloatArray:
    """Points seen by a camera of tilt TILT rather than none, at the same λ."""
    return transfer(rotation_from_tilt(TILT), -0.3, points.reshape(-1, 2)).reshape(points.shape)


@cases(CASES)
def test_solutions_are_sorted_finite_and_in_front(case: Case) -> None:
    x1, x2 = samples(case, noise=1e-3)
    found = case.solve(x1, x2)
    assert len(found) > 150
    assert found.sample.dtype == np.intp
    assert found.homography.shape == (len(found), 3, 3)
    assert (np.diff(found.sample) >= 0).all()
    assert np.isfinite(found.homography).all()
    assert (np.linalg.det(found.homography) > 0.0).all()
    for points in (x1, x2):
        radius2 = np.einsum("bki,bki->bk", points, points)[found.sample]
        assert (1.0 + found.distortion[:, None] * radius2 > 0.0).all()
    depth = np.einsum("mj,mkj->mk", found.homography[:, 2], lift(x1[found.sample], found.distortion[:, None]))
    assert (depth > 0.0).all()


@cases([case for case in CASES if case.exact])
def test_solutions_fit_the_sample_that_they_solve(case: Case) -> None:
    x1, x2 = samples(case, noise=1e-3)
    found = case.solve(x1, x2)
    for h, lam, sample in zip(found.homography, found.distortion, found.sample, strict=True):
        assert transfer(h, lam, x1[sample]) == pytest.approx(x2[sample], abs=1e-7)


@cases([case for case in CASES[:8] if case.name != "five_point_qep"])  # which weighs its equations by the range
def test_range_is_respected_and_complete(case: Case) -> None:
    x1, x2 = samples(case, noise=3e-3)
    wide = case.solve(x1, x2, distortion_range=(-1.5, 0.5))
    narrow = case.solve(x1, x2, distortion_range=(-0.6, -0.1))
    assert ((narrow.distortion > -0.6) & (narrow.distortion < -0.1)).all()
    inside = (wide.distortion > -0.6) & (wide.distortion < -0.1)
    assert np.array_equal(narrow.sample, wide.sample[inside])
    assert np.sort(narrow.distortion) == pytest.approx(np.sort(wide.distortion[inside]), abs=1e-8)


@cases([case for case in CASES[:8] if case.name != "five_point_qep"])
def test_an_open_range_ends_where_the_lens_model_does(case: Case) -> None:
    x1, x2 = samples(case, noise=3e-3)
    bounded, unbounded = (case.solve(x1, x2, distortion_range=(low, -low)) for low in (-5.0, -np.inf))
    radius2 = np.maximum(*(np.einsum("bki,bki->bk", points, points).max(axis=1) for points in (x1, x2)))
    for found in (bounded, unbounded):
        assert (np.abs(found.distortion) * radius2[found.sample] < 1.0).all()
    inside = np.abs(unbounded.distortion) < 5.0
    assert np.array_equal(bounded.sample, unbounded.sample[inside])
    assert np.sort(bounded.distortion) == pytest.approx(np.sort(unbounded.distortion[inside]), abs=1e-8)


@cases([case for case in CASES if isinstance(case.solve, partial) and "distortion" in case.solve.keywords])
@pytest.mark.parametrize("distortion", [-3.0, 3.0])
def test_a_known_lens_that_folds_at_a_point_has_no_solution(case: Case, distortion: float) -> None:
    x1, x2 = samples(case)
    found = case.solve(x1, x2, distortion=distortion)
    for points in (x1, x2):
        assert (abs(distortion) * np.einsum("bki,bki->bk", points, points)[found.sample] < 1.0).all()


@cases(CASES)
def test_a_sample_depends_neither_on_its_batch_nor_on_a_batch_axis(case: Case) -> None:
    x1, x2 = samples(case, batch=40, noise=1e-3)
    together = case.solve(x1, x2)
    for i in range(0, 40, 7):
        alone = case.solve(x1[i], x2[i])
        assert not alone.sample.any()
        assert np.array_equal(alone.homography, case.solve(x1[i : i + 1], x2[i : i + 1]).homography)
        mine = together.sample == i
        assert np.sort(together.distortion[mine]) == pytest.approx(np.sort(alone.distortion), abs=1e-9)


@cases(CASES)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_samples_that_are_not_finite_are_skipped(case: Case, value: float) -> None:
    x1, x2 = samples(case, batch=5)
    expected = case.solve(x1, x2)
    x1[1, 0, 1] = value
    x2[3, -1, 0] = value
    found = case.solve(x1, x2)
    kept = ~np.isin(expected.sample, (1, 3))
    assert np.array_equal(found.sample, expected.sample[kept])
    assert found.distortion == pytest.approx(expected.distortion[kept], abs=1e-9)


def _coincident(x1: FloatArray, x2: FloatArray, images: int) -> tuple[FloatArray, FloatArray]:
    for image, points in enumerate((x1, x2), start=1):
        if images & image:
            points[:, 1] = points[:, 0]
    return x1, x2


def _mirrored(x1: FloatArray, x2: FloatArray) -> tuple[FloatArray, FloatArray]:
    rng, count = np.random.default_rng(3), x1.shape[1]
    angles = 2.0 * np.pi * np.arange(count) / count + rng.uniform(0.0, 6.0, (200, 1))
    first = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=-1) + rng.uniform(-0.05, 0.05, (200, count, 2))
    return first, (0.9 * first + rng.uniform(-0.1, 0.1, (200, 1, 2))) * (1.0, -1.0)


def _collinear(x1: FloatArray, x2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """On a line through the centre, which stays straight for every λ."""
    along = np.linspace(-0.7, 0.6, x1.shape[1])[None, :, None] * np.array([0.8, 0.5])
    return along, along * 0.9


DEGENERATE: dict[str, tuple[Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]], int]] = {
    "none": (lambda x1, x2: (x1[:0], x2[:0]), 2),
    "at the centre": (lambda x1, x2: (0.0 * x1, 0.0 * x2), 2),
    "far out": (lambda x1, x2: (1e80 * x1, 1e80 * x2), 2),
    "too far to compute with": (lambda x1, x2: (1e160 * x1, 1e160 * x2), 2),
    "coincident in image 1": (partial(_coincident, images=1), 2),
    "coincident in image 2": (partial(_coincident, images=2), 2),
    "coincident": (partial(_coincident, images=3), 2),
    "mirrored": (_mirrored, 3),
    "collinear": (_collinear, 4),
}
"""Samples, and the number of points from which on they have no solution."""


@cases(CASES)
@pytest.mark.parametrize("kind", DEGENERATE)
def test_degenerate_samples_have_no_solution(case: Case, kind: str) -> None:
    spoil, least = DEGENERATE[kind]
    if case.count >= least:
        found = case.solve(*spoil(*samples(case, batch=50)))
        assert (len(found), found.homography.shape) == (0, (0, 3, 3))
    # No motion says nothing about distortion.
    still, _ = samples(CASES[0])
    assert len(CASES[0].solve(still, still)) == 0


@cases(CASES)
@pytest.mark.parametrize("shapes", [((3, 9, 2), (3, 9, 2)), ((9, 2), (9, 2)), ((2,), (2,)), ((), ()), None])
def test_wrong_shapes_raise(case: Case, shapes: tuple[Any, Any] | None) -> None:
    first, second = shapes or ((3, case.count, 2), (4, case.count, 2))
    with pytest.raises(ArgumentError):
        case.solve(np.zeros(first), np.zeros(second))


@pytest.mark.parametrize(
    ("solver", "name", "values"),
    [
        *((case, "distortion_range", [(0.5, -1.5), (0.1, 0.1), (np.nan, 0.5)]) for case in CASES[:8]),
        (CASES[0], "tilt", [0.1, (0.1, 0.2, 0.3), np.zeros((3, 2)), (np.nan, 0.0), (1.6, 0.0)]),
        (CASES[1], "starts", [(0.0, 0.0, -0.3), np.empty((0, 3)), [(0.0, np.nan, 0.1)], np.zeros((2, 2))]),
        (CASES[10], "distortion", [np.nan, np.zeros(3)]),
    ],
)
def test_wrong_arguments_raise(solver: Case, name: str, values: list[Any]) -> None:
    x1, x2 = samples(solver, batch=4)
    for value in values:
        with pytest.raises(ArgumentError):
            solver.solve(x1, x2, **{name: value})


def test_one_sample_has_one_tilt_an_image() -> None:
    (x1,), (x2,) = samples(CASES[0], batch=1)
    with pytest.raises(ArgumentError):
        CASES[0].solve(x1, x2, tilt=np.zeros((len(x1), 2, 2)))
    one, same = (CASES[0].solve(x1, x2, tilt=tilt) for tilt in (np.zeros((1, 2, 2)), (0.0, 0.0)))
    np.testing.assert_array_equal(one.homography, same.homography)


@pytest.mark.parametrize("case", CASES[:2], ids=lambda case: case.name)
def test_rigid_solutions_are_planar_motions(case: Case) -> None:
    found = case.solve(*samples(case, batch=20, noise=2e-3))
    for matrix in found.homography:
        motion = PlanarMotion.from_homography(matrix)
        np.testing.assert_allclose(motion.homography(), matrix, atol=1e-6)
        assert motion.height == pytest.approx(1.0, abs=1e-6)


@given(st.data(), st.sampled_from([case for case in CASES if not case.turns]))
@settings(max_examples=100, deadline=None)
def test_any_points_give_finite_solutions_or_none(data: st.DataObject, case: Case) -> None:
    # Few different values make coincident, collinear and symmetric points likely.
    coordinate = st.sampled_from([0.0, 0.5, -0.5, 1.0, 0.25, -0.8, 1e-9, 1e6]) | st.floats(allow_nan=True)
    values = data.draw(st.lists(coordinate, min_size=4 * case.count, max_size=4 * case.count))
    x1, x2 = np.array(values).reshape(2, case.count, 2)
    found = case.solve(x1, x2)
    assert np.isfinite(found.homography).all()
    assert np.isfinite(found.distortion).all()
