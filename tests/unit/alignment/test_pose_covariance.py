"""Covariances of poses: what the poses scatter by, whatever frame and unit they are given in."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import rdstitch
from examples.benchmarks.consistency import OPTIONS, errors, rendered
from examples.worlds.adverse_sets import adverse_set
from examples.worlds.alignment_scenes import grid, scene
from rdstitch.alignment import AlignmentOptions, align
from rdstitch.alignment.motion_models import LOG_HEIGHT, PSI, THETA, YAW, X, Y
from rdstitch.alignment.result import PlanarPoses
from rdstitch.arrays import FloatArray
from rdstitch.choices import TrajectoryFrame
from rdstitch.export.trajectory_files import as_csv
from rdstitch.trajectories.trajectory import Trajectory

FOCAL = 520.0


def _values(path: Trajectory) -> FloatArray:
    return np.column_stack([path.position, path.height, path.yaw])


def test_standard_deviations_are_what_poses_scatter_by() -> None:
    """Of positions, which the focal length rules; of the rest at least, since links may share their keypoints."""
    errors, predicted = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        poses = grid(3, 2, (0.3, 0.25), 0.2, rng)
        guess = FOCAL * float(np.exp(rng.normal(0.0, 0.01)))
        given = scene(poses, focal=FOCAL, guess=guess, tilt=(0.1, -0.05), rng=rng, per_link=80)
        p = given.poses
        truth = PlanarPoses(p[:, YAW], p[:, [X, Y]], np.exp(p[:, LOG_HEIGHT]), p[:, [PSI, THETA]])
        options = AlignmentOptions(model="similarity", lens="division", pose_covariance=True)
        path = Trajectory.from_alignment(align(given.cameras, given.links, options))
        if seed == 0:
            unasked = align(given.cameras, given.links, replace(options, pose_covariance=False))
            assert Trajectory.from_alignment(unasked).covariance is None
        np.testing.assert_array_equal(path.covariance[0], 0.0)
        errors.append(_values(path)[-1] - _values(Trajectory.from_poses(truth))[-1])
        predicted.append(np.diag(path.covariance[-1]))
    scatter, std = np.sqrt(np.mean(np.square(errors), axis=0)), np.sqrt(np.mean(predicted, axis=0))
    assert (std[:2] / scatter[:2] > 0.6).all()
    assert (std[:2] / scatter[:2] < 1.7).all()
    assert (std[2:] / scatter[2:] > 0.8).all()
    # The centre and the further coefficients of a lens may be anything usual; here they are zero.
    assert (std[2:] / scatter[2:] < 20.0).all()


def _sampled() -> tuple[PlanarPoses, list[PlanarPoses]]:
    """Three poses with a joint covariance, and draws from it."""
    rng = np.random.default_rng(3)
    mean = np.array([[1.0, 2.0, 2.0, 0.3], [2.0, 2.5, 2.2, 0.9], [4.0, 1.0, 1.8, -2.0]])
    root = 1e-4 * rng.normal(size=(12, 12))
    joint = (root @ root.T).reshape(3, 4, 3, 4)

    def poses(values: FloatArray) -> PlanarPoses:
        return PlanarPoses(values[:, 3], values[:, :2], values[:, 2], np.zeros((3, 2)))

    draws = [poses(mean + (root @ rng.normal(size=12)).reshape(3, 4)) for _ in range(4000)]
    own = np.stack([joint[k, :, k] for k in range(3)])
    return replace(poses(mean), covariance=own, with_first=joint[:, :, 0]), draws


def test_the_frame_of_the_first_image_and_the_map_keep_them_true() -> None:
    given, draws = _sampled()
    to_map = np.array([[0.6, 0.8, 500_000.0], [0.8, -0.6, 5_000_000.0]]) * [[3.0], [3.0]]
    for moved in (partial(Trajectory.from_poses, height=1.5), partial(Trajectory.on_map, to_map=to_map)):
        path = moved(given)
        spread = np.array([_values(moved(draw)) - _values(path) for draw in draws])
        found = np.einsum("kni,knj->nij", spread, spread) / len(spread)
        scale = np.sqrt(np.einsum("nii->ni", np.maximum(found, 1e-20)))
        scale = scale[:, :, None] * scale[:, None]
        np.testing.assert_allclose(path.covariance / scale, found / scale, atol=0.08)


def test_on_a_map_the_focal_length_is_in_the_heights() -> None:
    """Places are as exact as the map, whatever images know of lengths: what they are wrong by, its scale is too."""
    rng, noise, length_std, scale_std = np.random.default_rng(4), 0.003, 0.05, 0.02
    place, height = rng.uniform(-3.0, 3.0, (5, 2)) * [[0.0], [1.0], [1.0], [1.0], [1.0]], np.linspace(1.0, 1.2, 5)
    squares = []
    for _ in range(400):
        length, map_error = length_std * rng.normal(), scale_std * (rng.normal(size=2) @ [1.0, 1.0j])
        found = (place + noise * rng.normal(size=(5, 2)) * (place != 0.0)) * (1.0 + length)
        covariance = np.zeros((5, 4, 4))
        covariance[1:, :2, :2] = noise**2 * np.eye(2) + length_std**2 * found[1:, :, None] * found[1:, None]
        scale = 40.0 * np.exp(0.3j + map_error) / (1.0 + length)
        to_map = np.array([[scale.real, scale.imag, 5e5], [scale.imag, -scale.real, 5e6]])
        poses = PlanarPoses(np.zeros(5), found, height, np.zeros((5, 2)), covariance)
        path = Trajectory.on_map(poses, to_map, length_std=length_std, scale_std=scale_std)
        true = 40.0 * np.exp(0.3j) * (place @ [1.0, -1.0j])
        right = np.column_stack([5e5 + true.real, -5e6 - true.imag, 40.0 * height, np.full(5, 0.3)])
        squares.append((_values(path) - right) ** 2 / np.maximum(np.einsum("nii->ni", path.covariance), 1e-9))
    of_each = np.mean(squares, axis=0)
    assert (of_each[0, :2] < 1e-6).all()
    assert (of_each[1:] > 0.8).all()
    assert (of_each[1:] < 1.25).all()


@pytest.mark.parametrize(("frame", "sign"), [("enu", -1.0), ("camera", 1.0)])
def test_the_table_has_them_in_its_own_axes_and_units(frame: TrajectoryFrame, sign: float) -> None:
    path = Trajectory.from_poses(_sampled()[0])
    table = np.genfromtxt(as_csv(path, frame).splitlines(), delimiter=",", names=True)
    degrees = np.degrees(1.0)
    np.testing.assert_allclose(table["cov_x_x"], path.covariance[:, 0, 0], rtol=1e-8)
    np.testing.assert_allclose(table["cov_x_y"], sign * path.covariance[:, 0, 1], rtol=1e-8)
    np.testing.assert_allclose(table["cov_y_yaw_deg"], sign * degrees * path.covariance[:, 1, 3], rtol=1e-8)
    np.testing.assert_allclose(table["cov_height_height"], path.covariance[:, 2, 2], rtol=1e-8)
    np.testing.assert_allclose(table["cov_yaw_deg_yaw_deg"], degrees**2 * path.covariance[:, 3, 3], rtol=1e-8)
    np.testing.assert_allclose(table["y"], sign * path.position[:, 1], atol=1e-9)


@pytest.mark.parametrize(("kind", "seed"), [("relief", 2), ("plane", 15), ("cylinder", 99106)])
def test_what_the_model_does_not_describe_is_in_the_uncertainty(kind: str, seed: int) -> None:
    """Else the height is 4 deviations off over hills, 8 with a lens that was held too simple, λ 17 at a curved wall."""
    sequence = adverse_set(kind, seed) if kind == "cylinder" else rendered(kind, seed)
    options = replace(OPTIONS, pose_covariance=True)
    stitched = rdstitch.mosaic([sequence.frame(k) for k in range(len(sequence))], None, options)
    off = errors(sequence, stitched.registration.alignment)
    assert (np.concatenate([off["pose"], off["λ"]]) < 3.0).all()
