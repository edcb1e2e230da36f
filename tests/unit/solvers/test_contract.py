"""What holds of every minimal solver: shapes, signs, ranges, and quiet refusal of degenerate samples."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest

from rdstitch import solvers
from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.planar_motion import rotation_from_tilt
from rdstitch.radial_homography import lift, transfer
from rdstitch.solvers import Solutions
from tests.instances import planar_instances, rotation_instances

TILT = (0.12, -0.2)


@dataclass(frozen=True)
class Case:
    """A solver that is told what it needs, and how many points it takes."""

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
    Case("five_point_qep", 5, solvers.five_point_qep, exact=False),
    Case("rotation_two_point", 2, solvers.rotation_two_point, turns=True),
    Case("rotation_three_point", 3, solvers.rotation_three_point, exact=False, turns=True),
    Case("two_point_rigid", 2, partial(solvers.two_point_rigid, distortion=-0.3, tilt=TILT)),
    Case("two_point_similarity", 2, partial(solvers.two_point_similarity, distortion=-0.3, tilt=TILT)),
    Case("four_point_dlt", 4, partial(solvers.four_point_dlt, distortion=-0.3)),
    Case("rotation_two_point_focal", 2, partial(solvers.rotation_two_point_focal, distortion=-0.3), turns=True),
]
every_solver = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
searching = pytest.mark.parametrize("case", CASES[:8], ids=lambda case: case.name)


def samples(case: "Case | int", batch: int = 300, noise: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Points of planar motions with the tilt and the λ that the cases are told, or of rotations with that λ."""
    count = case.count if isinstance(case, Case) else case
    if isinstance(case, Case) and case.turns:
        turned = rotation_instances(batch, count, seed=7, distortion=(-0.3, -0.3), noise=noise)
        return turned.x1, turned.x2
    instances = planar_instances(batch, count, seed=7, distortion=(-0.3, -0.3), max_tilt=0.0, noise=noise)
    if count == 2:
        return tilted(instances.x1), tilted(instances.x2)
    return instances.x1, instances.x2


def tilted(points: FloatArray) -> FloatArray:
    """Points seen by a camera of tilt TILT rather than none, at the same λ."""
    return transfer(rotation_from_tilt(TILT), -0.3, points.reshape(-1, 2)).reshape(points.shape)


@every_solver
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


@every_solver
def test_solutions_fit_the_sample_that_they_solve(case: Case) -> None:
    if not case.exact or "point_rigid" in case.name:
        pytest.skip("leaves part of the sample to the data")
    x1, x2 = samples(case, noise=1e-3)
    found = case.solve(x1, x2)
    for i, (h, lam) in enumerate(zip(found.homography, found.distortion, strict=True)):
        sample = found.sample[i]
        assert transfer(h, lam, x1[sample]) == pytest.approx(x2[sample], abs=1e-7)


@searching
def test_range_is_respected_and_complete(case: Case) -> None:
    if case.name == "five_point_qep":
        pytest.skip("weighs its equations by the range")
    x1, x2 = samples(case, noise=3e-3)
    wide = case.solve(x1, x2, distortion_range=(-1.5, 0.5))
    narrow = case.solve(x1, x2, distortion_range=(-0.6, -0.1))
    assert ((narrow.distortion > -0.6) & (narrow.distortion < -0.1)).all()
    inside = (wide.distortion > -0.6) & (wide.distortion < -0.1)
    assert np.array_equal(narrow.sample, wide.sample[inside])
    assert np.sort(narrow.distortion) == pytest.approx(np.sort(wide.distortion[inside]), abs=1e-8)


@every_solver
def test_one_sample_needs_no_batch_axis(case: Case) -> None:
    x1, x2 = samples(case)
    single, batch = case.solve(x1[0], x2[0]), case.solve(x1[:1], x2[:1])
    assert len(single) > 0
    assert np.array_equal(single.sample, np.zeros(len(single)))
    assert np.array_equal(single.homography, batch.homography)


@every_solver
def test_a_sample_does_not_depend_on_its_batch(case: Case) -> None:
    x1, x2 = samples(case, batch=40, noise=1e-3)
    together = case.solve(x1, x2)
    for i in range(0, 40, 7):
        alone = case.solve(x1[i], x2[i])
        mine = together.sample == i
        assert np.sort(together.distortion[mine]) == pytest.approx(np.sort(alone.distortion), abs=1e-9)


@every_solver
def test_an_empty_batch_has_no_solution(case: Case) -> None:
    none = np.empty((0, case.count, 2))
    found = case.solve(none, none)
    assert len(found) == 0
    assert found.homography.shape == (0, 3, 3)


@every_solver
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


@every_solver
@pytest.mark.parametrize("scale", [1e80, 1e160])
def test_points_too_far_out_to_compute_with_have_no_solution(case: Case, scale: float) -> None:
    x1, x2 = samples(case, batch=5)
    assert len(case.solve(x1 * scale, x2 * scale)) == 0


@every_solver
@pytest.mark.parametrize("image", [0, 1, 2])
def test_coincident_points_have_no_solution(case: Case, image: int) -> None:
    x1, x2 = samples(case, batch=50)
    if image != 1:
        x1[:, 1] = x1[:, 0]
    if image != 0:
        x2[:, 1] = x2[:, 0]
    assert len(case.solve(x1, x2)) == 0


@every_solver
def test_all_points_at_the_centre_have_no_solution(case: Case) -> None:
    zeros = np.zeros((3, case.count, 2))
    assert len(case.solve(zeros, zeros)) == 0


@every_solver
def test_mirrored_samples_have_no_solution(case: Case) -> None:
    if case.count == 2:
        pytest.skip("two points have no orientation")
    rng = np.random.default_rng(3)
    angles = 2.0 * np.pi * np.arange(case.count) / case.count + rng.uniform(0.0, 6.0, (200, 1))
    x1 = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=-1) + rng.uniform(-0.05, 0.05, (200, case.count, 2))
    moved = 0.9 * x1 + rng.uniform(-0.1, 0.1, (200, 1, 2))
    assert len(case.solve(x1, moved * (1.0, -1.0))) == 0


@pytest.mark.parametrize("case", [c for c in CASES if c.count >= 4], ids=lambda case: case.name)
def test_collinear_points_have_no_solution(case: Case) -> None:
    # A line through the centre stays straight for every λ.
    along = np.linspace(-0.7, 0.6, case.count)[None, :, None] * np.array([0.8, 0.5])
    moved = along * 0.9
    assert len(case.solve(along, moved)) == 0


@every_solver
@pytest.mark.parametrize("shapes", [((3, 9, 2), (3, 9, 2)), ((9, 2), (9, 2)), ((2,), (2,)), ((), ())])
def test_wrong_shapes_raise(case: Case, shapes: tuple[Any, Any]) -> None:
    with pytest.raises(ArgumentError):
        case.solve(np.zeros(shapes[0]), np.zeros(shapes[1]))


@every_solver
def test_images_of_different_shape_raise(case: Case) -> None:
    with pytest.raises(ArgumentError):
        case.solve(np.zeros((3, case.count, 2)), np.zeros((4, case.count, 2)))


@searching
@pytest.mark.parametrize("limits", [(0.5, -1.5), (0.1, 0.1), (np.nan, 0.5)])
def test_an_empty_range_raises(case: Case, limits: tuple[float, float]) -> None:
    x1, x2 = samples(case, batch=2)
    with pytest.raises(ArgumentError):
        case.solve(x1, x2, distortion_range=limits)


@pytest.mark.parametrize("tilt", [0.1, (0.1, 0.2, 0.3), np.zeros((3, 2)), (np.nan, 0.0), (1.6, 0.0)])
def test_a_wrong_tilt_raises(tilt: Any) -> None:
    x1, x2 = samples(2, batch=4)
    with pytest.raises(ArgumentError):
        solvers.two_point(x1, x2, tilt=tilt)


@pytest.mark.parametrize("starts", [(0.0, 0.0, -0.3), np.empty((0, 3)), [(0.0, np.nan, 0.1)], np.zeros((2, 2))])
def test_wrong_starts_raise(starts: Any) -> None:
    x1, x2 = samples(3, batch=4)
    with pytest.raises(ArgumentError):
        solvers.three_point(x1, x2, starts=starts)


@pytest.mark.parametrize("distortion", [np.nan, np.zeros(3)])
def test_a_wrong_distortion_raises(distortion: Any) -> None:
    x1, x2 = samples(4, batch=5)
    with pytest.raises(ArgumentError):
        solvers.four_point_dlt(x1, x2, distortion)


def test_no_motion_says_nothing_about_distortion() -> None:
    x1, _ = samples(2)
    assert len(solvers.two_point(x1, x1, TILT)) == 0
