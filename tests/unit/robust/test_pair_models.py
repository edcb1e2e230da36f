"""The family of pair models: derivatives, retraction, and where they start."""

import numpy as np
import pytest

from rdstitch.planar_motion import PlanarMotion, rigid_in_plane, rotation_from_tilt
from rdstitch.robust.pair_models import HomographyModel, PairModel, PlanarModel

MOTION = PlanarMotion((0.1, -0.15), 0.4, (0.3, -0.2), 1.15)
K = np.diag([1.3, 1.3, 1.0])
H = K @ MOTION.homography() @ np.linalg.inv(K)

MODELS = [
    PlanarModel(1.3),
    PlanarModel(1.3, 0.3),
    PlanarModel(1.3, 0.3, height_free=True),
    PlanarModel(1.3, tilts=((0.1, 0.0), (-0.05, 0.1)), height_free=True),
    PlanarModel(1.3, tilts=((0.1, 0.0), (0.1, 0.0))),
    HomographyModel(),
]


@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_jacobian_is_the_derivative_of_a_step(model: PairModel) -> None:
    state = model.initialize(H)
    jacobian = model.jacobian(state)
    for index in range(jacobian.shape[1]):
        step = np.zeros(jacobian.shape[1])
        step[index] = 1e-6
        ahead, behind = (model.homography(model.retract(state, s)) for s in (step, -step))
        np.testing.assert_allclose(jacobian[:, index], ((ahead - behind) / 2e-6).ravel(), atol=1e-7)


def test_free_models_start_at_the_homography_itself() -> None:
    for model in (PlanarModel(1.3, height_free=True), HomographyModel()):
        found = model.homography(model.initialize(H))
        np.testing.assert_allclose(found / found[2, 2], H / H[2, 2], atol=1e-9)


def test_known_tilts_are_kept() -> None:
    tilts = ((0.1, 0.0), (-0.05, 0.1))
    r1, r2 = rotation_from_tilt(tilts)
    h = K @ r2 @ rigid_in_plane(0.3, (0.2, 0.1), 0.9) @ r1.T @ np.linalg.inv(K)
    model = PlanarModel(1.3, tilts=tilts, height_free=True)
    np.testing.assert_allclose(model.homography(model.initialize(h)), h, atol=1e-12)
    assert model.motion(model.initialize(h)).height == pytest.approx(0.9)


def test_the_prior_pulls_the_focal_length_back() -> None:
    model = PlanarModel(1.3, 0.2)
    state = model.retract(model.initialize(H), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.1]))
    residual, derivative = model.prior(state)
    assert residual == pytest.approx([0.5])
    np.testing.assert_allclose(derivative, [[0, 0, 0, 0, 0, 5.0]])
    assert model.focal_correction(state) == pytest.approx(np.exp(0.1))
