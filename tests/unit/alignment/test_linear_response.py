"""The linearized adjustment says what adjusting anew finds."""

from dataclasses import replace

import numpy as np
import pytest

from examples.worlds.alignment_scenes import grid_scene
from rdstitch.alignment.least_squares.bundle_adjustment import (
    BundleAdjuster,
    BundleAdjustmentResult,
    FreeParameters,
    Parameters,
)
from rdstitch.alignment.least_squares.linear_response import LinearResponse
from rdstitch.alignment.least_squares.link_equations import LinearizedErrors, whitened_errors
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.priors import Priors
from rdstitch.alignment.motion_models import MODELS, MotionModel
from rdstitch.arrays import FloatArray
from rdstitch.choices import ModelName
from rdstitch.geometry.radial_homography import inverses, project
from rdstitch.robust.priors import Prior

LENS = np.array([True, True, False, False, False])


def _adjusted(model: MotionModel) -> tuple[BundleAdjuster, BundleAdjustmentResult]:
    truth = grid_scene(3, 2, (0.4, 0.35), 0.2, seed=5, per_link=60, outliers=0.0)
    observations = Observations.from_links(truth.links, truth.cameras)
    shared = model.shared_from_physical(np.array([0.0, 0.0, np.log(1.3)])) if model.shared_names else np.zeros(0)
    poses = model.nearest_poses(truth.truth, shared, np.zeros((len(truth.truth), 2)))
    free, priors = FreeParameters.fixing(model, 6, [0], LENS), Priors.none(model, 6)
    middle = model.physical_parameters(shared)[0].tolist()
    priors = replace(priors, shared=tuple(Prior(((1.0, value, 0.1),)) for value in middle))
    adjuster = BundleAdjuster(model, observations, free, replace(priors, poses_precision=priors.poses_precision + 1.0))
    return adjuster, adjuster.run(Parameters(poses, shared, np.array([-0.25, 0.0, 0.0, 0.0, 0.0])))


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_changes_are_the_derivatives_of_the_errors(model: MotionModel) -> None:
    adjuster, adjusted = _adjusted(model)
    response, rng = LinearResponse.of(adjuster, adjusted), np.random.default_rng(0)
    poses = rng.normal(size=(*adjuster.free.poses.shape, 2)) * adjuster.free.poses[..., None]
    shared = rng.normal(size=(len(adjusted.parameters.shared) + 2, 2))
    found = np.concatenate([response.changes(part, poses, shared) for part in response.parts()])

    def errors(size: float, column: int) -> FloatArray:
        moved = adjusted.parameters.retract(model, size * poses[..., column], size * shared[:, column], LENS)
        matrices = model.matrices(moved.poses, moved.shared).matrices
        i, j = adjuster.observations.image1, adjuster.observations.image2
        return whitened_errors(adjuster.observations, matrices[j] @ inverses(matrices)[i], moved.lens)

    for column in range(2):
        numeric = (errors(1e-6, column) - errors(-1e-6, column)) / 2e-6
        # The whitening moves as well, in proportion to the errors: that is left out.
        assert np.linalg.norm(found[:, :, column] - numeric) < 0.01 * np.linalg.norm(numeric)


@pytest.mark.parametrize("model", ["similarity", "tilting"])
def test_steps_are_what_adjusting_anew_finds(model: ModelName) -> None:
    """The points of image 2 are moved by waves as large as the noise."""
    adjuster, adjusted = _adjusted(MODELS[model])
    response, observations = LinearResponse.of(adjuster, adjusted), adjuster.observations
    wave = 0.3 * np.stack([np.sin(9.0 * observations.points2[:, 1]), np.cos(7.0 * observations.points2[:, 0])], axis=1)
    moved = replace(observations, points2=observations.points2 + wave / observations.scale2[0])
    again = replace(adjuster, observations=moved).run(adjusted.parameters)

    def field(part: LinearizedErrors) -> FloatArray:
        change: FloatArray = np.einsum("mij,mj->mi", part.by_point2, wave[part.rows] / observations.scale2[0])
        return change[:, :, None]

    poses, shared = response.steps_of(field, 1)
    size = len(adjusted.parameters.shared)
    lens = again.parameters.lens - adjusted.parameters.lens
    np.testing.assert_allclose(shared[size:, 0], lens[LENS], rtol=0.2, atol=0.1 * np.abs(lens[LENS]).max())
    centres = [project(inverses(found.matrices.matrices)[:, :, 2]) for found in (adjusted, again)]
    there = adjusted.parameters.retract(adjuster.model, poses[..., 0], shared[:, 0], LENS)
    predicted = project(inverses(adjuster.model.matrices(there.poses, there.shared).matrices)[:, :, 2])
    assert np.linalg.norm(predicted - centres[1]) < 0.25 * np.linalg.norm(centres[1] - centres[0])


def test_the_curvature_of_normal_errors_is_that_of_their_distribution() -> None:
    """``∫ (w + r² w') / ∫ w`` over ``t = r²/2``, which has the density exp(-t)."""
    adjuster, adjusted = _adjusted(MODELS["similarity"])
    t = np.linspace(0.0, 40.0, 40_001)
    ratio = 1.0 / (1.0 + 2.0 * t / 3.5**2)
    expected = float((np.exp(-t) * ratio**2 * (2.0 * ratio - 1.0)).sum() / (np.exp(-t) * ratio**2).sum())
    assert LinearResponse.of(adjuster, adjusted).curvature == pytest.approx(expected, abs=0.03)
