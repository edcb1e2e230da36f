"""Packed features match as unpacked ones do."""

import cv2
import numpy as np
import pytest

from rdstitch.features import FeatureOptions, PackedFeatures, detect, match
from rdstitch.synthetic import ground


@pytest.mark.parametrize(("kind", "bytes_each"), [("rootsift", (1, 2)), ("sift", (1,)), ("orb", (1,)), ("surf", (2,))])
def test_packed_features_match_as_before(kind: str, bytes_each: tuple[int, ...]) -> None:
    colour = ground((320, 240), 11, 1).region(0, 0, 320, 240)
    image = np.rint(cv2.GaussianBlur(colour, (0, 0), 1.0).reshape(240, 320) * 255).astype(np.uint8)
    options = FeatureOptions(kind=kind, max_features=500)
    features = [detect(image, options), detect(np.ascontiguousarray(image[:, 40:]), options)]
    packed = [PackedFeatures.pack(found) for found in features]
    again = [found.unpack() for found in packed]
    assert packed[0].descriptors.itemsize in bytes_each
    assert again[0].binary is features[0].binary
    before, after = (match(first, second) for first, second in (features, again))
    if kind in ("rootsift", "sift", "orb"):
        np.testing.assert_array_equal(again[0].descriptors, features[0].descriptors)
    common = set(map(tuple, before.indices.tolist())) & set(map(tuple, after.indices.tolist()))
    assert len(common) >= 0.98 * len(before) > 50


def test_integers_beyond_a_byte_and_numbers_beyond_half_precision_are_kept() -> None:
    one = detect(np.zeros((1, 1), np.uint8), FeatureOptions())
    values = np.zeros((3, 8), np.float32)
    for largest, kind in ((255.0, np.uint8), (400.0, np.float16), (1e6, np.float32), (0.5, np.float16)):
        values[1, 2] = largest
        numbers = np.arange(3.0)
        features = type(one)(np.zeros((3, 2)), values, numbers, numbers, numbers, None, "made up")
        packed = PackedFeatures.pack(features)
        assert packed.descriptors.dtype == kind
        np.testing.assert_array_equal(packed.unpack().descriptors, values)
