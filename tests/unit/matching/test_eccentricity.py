"""Keypoints lie at the middles of blobs' images, which are not the images of their middles."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features import FeatureOptions, detect
from rdstitch.matching.eccentricity import blob_radii, eccentricity

OBLIQUE = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0011, 0.0004, 1.0]])
SHARP = 4  # pixels of the drawing per pixel of the image and side


def _oblique(points: FloatArray) -> FloatArray:
    mapped = np.column_stack([points, np.ones(len(points))]) @ OBLIQUE.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _images(center: FloatArray, radius: float) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A dark disc on light ground, 640 x 480 pixels, from above and obliquely."""
    turns = np.linspace(0.0, 2.0 * np.pi, 400)
    outline = center + radius * np.column_stack([np.cos(turns), np.sin(turns)])
    images = []
    for points in (outline, _oblique(outline)):
        canvas = np.full((480 * SHARP, 640 * SHARP), 220, dtype=np.uint8)
        cv2.fillPoly(canvas, [np.rint((points + 0.5) * SHARP - 0.5).astype(np.int32)], 30)
        images.append(np.asarray(cv2.resize(canvas, (640, 480), interpolation=cv2.INTER_AREA), dtype=np.uint8))
    return images[0], images[1]


@pytest.mark.parametrize("kind", ["sift", "surf"])
def test_keypoints_of_a_disc_are_where_it_says(kind: str) -> None:
    center, radius = np.array([420.0, 250.0]), 60.0
    keypoints = []
    for image, where in zip(_images(center, radius), (center, _oblique(center[None])[0]), strict=True):
        features = detect(image, FeatureOptions(kind=kind))
        keypoints.append(features.take(np.argsort(np.linalg.norm(features.points - where, axis=1))[:1]))
    above, oblique = keypoints
    radii = blob_radii(above)
    np.testing.assert_allclose(radii, radius, rtol=0.05)
    moved, said = oblique.points - _oblique(above.points), eccentricity(_oblique, above.points, radii)
    assert np.linalg.norm(said) > 1.0
    assert np.linalg.norm(moved - said) < 0.4 * np.linalg.norm(said)


def test_it_is_the_shift_of_the_middle_of_a_disc() -> None:
    center, radius = np.array([[200.0, 150.0]]), 30.0
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 401)] * 2), axis=-1).reshape(-1, 2)
    places = center + radius * grid[np.sum(grid**2, axis=1) < 1.0]
    step = 0.05 * np.eye(2)
    slope = np.stack([(_oblique(places + unit) - _oblique(places - unit)) / 0.1 for unit in step], axis=-1)
    area = np.linalg.det(slope)
    truth = area @ _oblique(places) / area.sum() - _oblique(center)
    found = eccentricity(_oblique, center, np.array([radius]))
    np.testing.assert_allclose(found, truth, rtol=0.04)


def test_nothing_moves_without_perspective_nor_without_size() -> None:
    points, turn = np.random.default_rng(0).uniform(0.0, 400.0, (9, 2)), np.array([[0.8, -0.6], [0.3, 1.2]])
    np.testing.assert_allclose(eccentricity(lambda p: p @ turn + 5.0, points, np.full(9, 20.0)), 0.0, atol=1e-9)
    assert (eccentricity(_oblique, points, np.zeros(9)) == 0.0).all()


def test_discs_that_are_not_seen_whole_have_none() -> None:
    points = np.array([[10.0, 0.0], [60.0, 0.0]])
    found = eccentricity(lambda p: np.where(p[:, :1] < 20.0, np.nan, p), points, np.full(2, 15.0))
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()


def test_corners_have_no_blob() -> None:
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(0, 255, (60, 80), dtype=np.uint8), (640, 480))
    found = detect(np.asarray(image, dtype=np.uint8), FeatureOptions(kind="orb"))
    assert len(found) > 10
    assert (blob_radii(found) == 0.0).all()
