"""Symmetries of the minimal problems: what may change in the input without changing the answer."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rdstitch import solvers
from rdstitch.arrays import FloatArray
from rdstitch.planar_motion import rotation_from_tilt, tilt_from_normal
from rdstitch.solvers import Solutions
from tests.instances import planar_instances
from tests.planar_constraints import constraint_residuals

seeds = st.integers(0, 10**6)
angles = st.floats(-np.pi, np.pi)
BATCH = 20
# Their thresholds hold for nearly all instances, not for all: the same ones each time.
statistical = settings(max_examples=15, deadline=None, derandomize=True)
# Noise, so that the answers are not just the truth again.
NOISE = 2e-3


def same(first: Solutions, second: Solutions, scale: float = 1.0, tolerance: float = 1e-7) -> None:
    """Whether all λ of both, the second's times ``scale``, are the same in nearly every sample: nearly double roots,
    which come in twos, depend on rounding.
    """
    different = 0
    for sample in range(BATCH):
        a = first.distortion[first.sample == sample]
        b = second.distortion[second.sample == sample] * scale
        different += len(a) != len(b) or bool((np.abs(np.sort(a) - np.sort(b)) > tolerance).any())
    assert len(first) > BATCH // 4
    assert different <= 1 + BATCH // 20


def rotated(points: FloatArray, angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


@given(seeds, st.permutations(range(4)))
@statistical
def test_order_of_points_does_not_matter(seed: int, order: list[int]) -> None:
    instances = planar_instances(BATCH, 4, seed=seed, noise=NOISE)
    x1, x2 = instances.x1, instances.x2
    same(solvers.four_point(x1, x2), solvers.four_point(x1[:, order], x2[:, order]))
    first_two = sorted(order[:2])
    tilt = instances.tilt[0]
    same(
        solvers.two_point(x1[:, first_two], x2[:, first_two], tilt),
        solvers.two_point(x1[:, first_two[::-1]], x2[:, first_two[::-1]], tilt),
    )
    # The first point is where both distances start.
    others = [i for i in order if i > 0][:2]
    one_way, other_way = [0, *others], [0, *others[::-1]]
    same(
        solvers.three_point_similarity(x1[:, one_way], x2[:, one_way], tilt),
        solvers.three_point_similarity(x1[:, other_way], x2[:, other_way], tilt),
    )


@given(seeds)
@statistical
def test_images_may_be_exchanged(seed: int) -> None:
    instances = planar_instances(BATCH, 3, seed=seed, separate_tilts=True, noise=NOISE)
    tilts = np.stack([instances.tilt, instances.tilt2], axis=1)
    for solver, count in ((solvers.two_point, 2), (solvers.three_point_similarity, 3)):
        x1, x2 = instances.x1[:, :count], instances.x2[:, :count]
        forward, backward = solver(x1, x2, tilts), solver(x2, x1, tilts[:, ::-1])
        same(forward, backward)
        if len(forward) == len(backward):
            product = backward.homography @ forward.homography
            product /= product[:, 2:, 2:]
            alike = np.abs(forward.distortion - backward.distortion) < 1e-9
            if count == 2:
                assert product[alike] == pytest.approx(np.broadcast_to(np.eye(3), product[alike].shape), abs=1e-6)


@given(seeds, angles)
@statistical
def test_images_may_be_turned_together(seed: int, angle: float) -> None:
    instances = planar_instances(BATCH, 4, seed=seed, noise=NOISE)
    x1, x2 = instances.x1, instances.x2
    same(solvers.four_point(x1, x2), solvers.four_point(rotated(x1, angle), rotated(x2, angle)))
    normal = rotation_from_tilt(instances.tilt[0])[:, 2]
    turned = tilt_from_normal(np.append(rotated(normal[:2], angle), normal[2]))
    same(
        solvers.two_point(x1[:, :2], x2[:, :2], instances.tilt[0]),
        solvers.two_point(rotated(x1, angle)[:, :2], rotated(x2, angle)[:, :2], turned),
    )


@given(seeds, st.floats(0.3, 3.0), angles, angles)
@statistical
def test_five_points_need_no_focal_length_and_no_upright_images(
    seed: int, zoom: float, angle1: float, angle2: float
) -> None:
    instances = planar_instances(BATCH, 5, seed=seed, noise=NOISE)
    x1, x2 = instances.x1, instances.x2
    limits = (-1.5 / zoom**2, 0.5 / zoom**2)
    moved = solvers.five_point(zoom * rotated(x1, angle1), zoom * rotated(x2, angle2), limits)
    same(solvers.five_point(x1, x2), moved, scale=zoom**2)


@given(seeds)
@statistical
def test_rigid_solutions_are_planar_motions(seed: int) -> None:
    instances = planar_instances(BATCH, 3, seed=seed, noise=NOISE)
    two = solvers.two_point(instances.x1[:, :2], instances.x2[:, :2], instances.tilt[0])
    three = solvers.three_point(instances.x1, instances.x2)
    for found in (two, three):
        quartic, sextic = constraint_residuals(found.homography)
        assert np.abs(quartic).max(initial=0.0) < 1e-9
        assert np.abs(sextic).max(initial=0.0) < 1e-9
        assert np.linalg.det(found.homography) == pytest.approx(np.ones(len(found)), abs=1e-6)


@given(seeds)
@statistical
def test_four_point_solutions_satisfy_a_constraint(seed: int) -> None:
    instances = planar_instances(BATCH, 4, seed=seed, noise=NOISE)
    quartic, sextic = constraint_residuals(solvers.four_point(instances.x1, instances.x2).homography)
    # Where three points are nearly collinear a rounding error of λ changes H.
    assert np.mean(np.minimum(np.abs(quartic), np.abs(sextic)) < 1e-9) > 0.95


UNBOUNDED: list[tuple[Callable[..., Solutions], int, dict[str, Any]]] = [
    (solvers.two_point, 2, {}),
    (solvers.three_point, 3, {}),
    (solvers.three_point_similarity, 3, {}),
    (solvers.four_point, 4, {}),
    (solvers.five_point, 5, {}),
    (solvers.five_point_qep, 5, {}),
    (solvers.two_point_rigid, 2, {"distortion": -0.3}),
    (solvers.two_point_similarity, 2, {"distortion": -0.3}),
    (solvers.four_point_dlt, 4, {"distortion": -0.3}),
]


@given(st.data(), st.sampled_from(UNBOUNDED))
@settings(max_examples=100, deadline=None)
def test_any_points_give_finite_solutions_or_none(
    data: st.DataObject, case: tuple[Callable[..., Solutions], int, dict[str, Any]]
) -> None:
    solver, count, known = case
    # Few different values make coincident, collinear and symmetric points likely.
    coordinate = st.sampled_from([0.0, 0.5, -0.5, 1.0, 0.25, -0.8, 1e-9, 1e6]) | st.floats(allow_nan=True)
    values = data.draw(st.lists(coordinate, min_size=4 * count, max_size=4 * count))
    x1, x2 = np.array(values).reshape(2, count, 2)
    found = solver(x1, x2, **known)
    assert np.isfinite(found.homography).all()
    assert np.isfinite(found.distortion).all()
