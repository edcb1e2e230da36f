"""SIFT in tiles finds what it finds in the whole."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rdstitch.features import FeatureOptions
from rdstitch.features.opencv import OpenCVDetection
from rdstitch.features.sift_tiles import SiftTilesDetection
from rdstitch.synthetic import ground

OPTIONS = FeatureOptions()


@pytest.fixture(scope="module")
def grey() -> NDArray[np.uint8]:
    """Ground, as sharp as a lens leaves it, of two tiles by two."""
    texture = np.asarray(cv2.GaussianBlur(ground((1280, 800), 5, 1).region(0, 0, 1280, 800), (0, 0), 1.0))
    return np.asarray(np.clip(np.rint(texture.reshape(800, 1280) * 255), 0, 255), np.uint8)


def test_fine_keypoints_are_the_same(grey: NDArray[np.uint8]) -> None:
    """No keypoint is lost, or found twice, where tiles meet; and each is described as in the whole."""
    whole, tiles = OpenCVDetection.find(grey, OPTIONS), SiftTilesDetection.find(grey, OPTIONS)
    fine, small = (np.flatnonzero(found.scale < 6.5) for found in (whole, tiles))
    assert len(fine) == len(small) > 3000
    distance, partner = map(np.asarray, cKDTree(tiles.points[small]).query(whole.points[fine]))
    assert distance.max() < 0.01
    some = np.arange(0, len(fine), 40)
    one, two = whole.describe(fine[some]), tiles.describe(np.unique(small[partner[some]]))
    # Several keypoints at one place differ in their orientation.
    place = [np.column_stack([f.points, 10 * np.cos(f.angle), 10 * np.sin(f.angle)]) for f in (one, two)]
    distance, partner = map(np.asarray, cKDTree(place[1]).query(place[0]))
    same = distance < 0.01
    assert same.mean() > 0.7
    assert (np.abs(one.descriptors[same] - two.descriptors[partner[same]]).max(axis=1) <= 3).mean() > 0.99


def test_coarse_keypoints_are_as_many_and_as_strong(grey: NDArray[np.uint8]) -> None:
    whole, tiles = OpenCVDetection.find(grey, OPTIONS), SiftTilesDetection.find(grey, OPTIONS)
    for low, high in ((8.0, 16.0), (16.0, 64.0)):
        one, two = (found.response[(found.scale >= low) & (found.scale < high)] for found in (whole, tiles))
        assert len(two) == pytest.approx(len(one), rel=0.15)
        assert np.median(two) == pytest.approx(np.median(one), rel=0.1)
