"""Many pairs in lockstep: each comes out as if it were alone, bit for bit."""

import numpy as np
import pytest

from examples.worlds.correspondences import correspondences
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.division_model import distorted_ratio
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies, estimate_radial_homography
from rdstitch.robust.linearization import PairLenses, TransferDerivatives, differentiate, entry_equations, influence
from rdstitch.robust.measurements import Measurements


def _pairs(count: int) -> list[PairMatches]:
    pairs = []
    for seed in range(count):
        motion = ("rigid", "similarity", "homography")[seed % 3]
        outliers = (0.2, 0.5, 0.7)[seed % 3]
        matches = correspondences(60 + 35 * (seed % 5), seed=seed, outliers=outliers, motion=motion)
        camera = Camera(matches.truth.camera.image_size).with_guessed_focal()
        quality = np.linspace(1.0, 0.0, len(matches.points1)) if seed % 2 else None
        pairs.append(PairMatches(matches.points1, matches.points2, camera, camera, quality))
    rng = np.random.default_rng(0)
    first, second = rng.uniform((0, 0), (999, 799), (2, 80, 2))
    return [*pairs, PairMatches(first, second, camera, camera), PairMatches(first[:5], second[:5], camera, camera)]


@pytest.mark.parametrize("options", [EstimationOptions(), EstimationOptions(select_below=50)])
def test_a_pair_is_estimated_as_if_it_were_alone(options: EstimationOptions) -> None:
    pairs = _pairs(12)
    together = estimate_radial_homographies(pairs, options)
    assert sum(bool(found) for found in together) == 12
    for pair, found in zip(pairs, together, strict=True):
        alone = estimate_radial_homographies([pair], options)[0]
        assert alone.homography.tobytes() == found.homography.tobytes()
        assert alone.covariance.tobytes() == found.covariance.tobytes()
        assert alone.inliers.tobytes() == found.inliers.tobytes()
        assert (alone.iterations, alone.reason, alone.model) == (found.iterations, found.reason, found.model)


def test_one_pair_by_either_function_and_no_pairs() -> None:
    pair = _pairs(3)[1]
    one = estimate_radial_homography(pair.points1, pair.points2, pair.camera1.image_size, quality=pair.quality)
    assert one.homography.tobytes() == estimate_radial_homographies([pair], EstimationOptions())[0].homography.tobytes()
    assert estimate_radial_homographies([], EstimationOptions()) == []


@pytest.mark.parametrize("own", [False, True])
def test_normal_equations_are_those_of_the_jacobian(own: bool) -> None:
    rng = np.random.default_rng(1)
    points1 = rng.uniform((50, 50), (600, 420), (40, 2))
    points2 = points1 + np.array([4.0, 2.5])
    data = Measurements.from_pixels(points1, points2, Camera((640, 480)), Camera((640, 480)))
    h = np.eye(3) + 0.02 * rng.normal(size=(3, 3))
    lens = np.array([-0.2, -0.25, 0.03, 0.01, -0.02])
    size = 14 if own else 10

    def at(values: FloatArray, data: Measurements = data) -> TransferDerivatives:
        (first, second, mu), center = values[9:12, None], values[None, 12:]
        seen = PairLenses(first, second, mu, center) if own else PairLenses(first)
        return differentiate(values[:9].reshape(1, 3, 3), seen, data)

    def error(values: FloatArray, data: Measurements = data) -> FloatArray:
        u = at(values, data).image[0]
        second, mu, center = (values[10], values[11:12], values[12:, None]) if own else (values[9], None, 0.0)
        measured = u * distorted_ratio((u**2).sum(axis=0), np.asarray(second), mu) + center
        return np.asarray((measured - data.x2[0]) * data.px[0])

    values = np.concatenate([h.ravel(), lens])
    found = at(values)
    steps = 1e-6 * np.eye(14)[:size]
    jacobian = np.stack([(error(values + step) - error(values - step)) / 2e-6 for step in steps], axis=-1)
    camera = Camera((640, 480))
    ends = [
        [Measurements.from_pixels(points1 + side * axis, points2, camera, camera) for side in (1e-3, -1e-3)]
        for axis in np.eye(2)
    ]
    by_point = [(error(values, ahead) - error(values, behind)) / 2e-3 for ahead, behind in ends]
    sampson = np.stack(by_point, axis=1).transpose(2, 0, 1)
    precision = np.linalg.inv((np.eye(2) + sampson @ np.swapaxes(sampson, 1, 2)) / 2.0).transpose(1, 2, 0)
    squared = np.einsum("in,ijn,jn->n", error(values), precision, error(values))
    np.testing.assert_allclose(found.squared[0], squared, rtol=1e-5)
    relative = data.present[0] / (1.0 + found.squared[0] / 9.0)
    expected = np.einsum("inp,ijn,jnq,n->pq", jacobian, precision, jacobian, relative**2)
    gradient = np.einsum("inp,ijn,jn,n->p", jacobian, precision, error(values), relative**2)
    cost, normal, slope = entry_equations(found, data.present, np.array([3.0]), True)
    np.testing.assert_allclose(normal[0], expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(slope[0], gradient, rtol=1e-5, atol=1e-5 * np.abs(gradient).max())
    np.testing.assert_allclose(cost[0], (found.squared[0] * relative).sum())
    shares = influence(found, data.present, np.array([3.0]), True)[0]
    np.testing.assert_allclose(shares.sum(axis=0), slope[0])


def test_the_samples_of_a_pair_are_its_own_however_many_others_draw() -> None:
    """Beside a pair without a model, for which all solvers reach the limit of samples early."""
    options = EstimationOptions(max_iterations=250)
    hopeless = _pairs(1)[-2]
    for outliers in (0.42, 0.45, 0.48):
        matches = correspondences(80, seed=1, outliers=outliers, motion="homography")
        camera = Camera(matches.truth.camera.image_size).with_guessed_focal()
        pair = PairMatches(matches.points1, matches.points2, camera, camera)
        alone, beside = (estimate_radial_homographies(pairs, options)[0] for pairs in ([pair], [pair, hopeless]))
        assert (alone.iterations, alone.homography.tobytes()) == (beside.iterations, beside.homography.tobytes())
