"""The family of pair models: derivatives, retraction, and where they start."""

import math

import numpy as np
import pytest

from rdstitch.geometry.planar_motion import PlanarMotion, rigid_in_plane, rotation_from_tilt
from rdstitch.robust.pair_models import HomographyPairModel, PairModel, PlanarPairModel
from rdstitch.robust.priors import focal_prior

MOTION = PlanarMotion((0.1, -0.15), 0.4, (0.3, -0.2), 1.15)
K = np.diag([1.3, 1.3, 1.0])
H = K @ MOTION.homography() @ np.linalg.inv(K)

TILTS = np.array([[[0.1, 0.0], [-0.05, 0.1]]])

GUESS = focal_prior(math.log(1.3), 0.3, "guess")

MODELS = [
    PlanarPairModel(1.3),
    PlanarPairModel(1.3, GUESS),
    PlanarPairModel(1.3, GUESS, height_free=True),
    PlanarPairModel(1.3, tilts_known=True, height_free=True),
    PlanarPairModel(1.3, tilts_known=True),
    HomographyPairModel(),
]


@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_jacobian_is_the_derivative_of_a_step(model: PairModel) -> None:
    state = model.initialize(H[None], TILTS)
    jacobian = model.jacobian(state)[0]
    for index in range(jacobian.shape[1]):
        step = np.zeros((1, jacobian.shape[1]))
        step[0, index] = 1e-6
        ahead, behind = (model.homography(model.retract(state, s)) for s in (step, -step))
        np.testing.assert_allclose(jacobian[:, index], ((ahead - behind) / 2e-6).ravel(), atol=1e-7)


def test_known_tilts_are_kept() -> None:
    r1, r2 = rotation_from_tilt(TILTS[0])
    h = K @ r2 @ rigid_in_plane(0.3, (0.2, 0.1), 0.9) @ r1.T @ np.linalg.inv(K)
    model = PlanarPairModel(1.3, tilts_known=True, height_free=True)
    state = model.initialize(h[None], TILTS)
    np.testing.assert_allclose(model.homography(state)[0], h, atol=1e-12)
    assert model.motion(state[0]).height == pytest.approx(0.9)
