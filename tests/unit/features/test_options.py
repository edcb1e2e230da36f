"""What is left open in the options of detection depends on how many images share the work."""

import pytest

from rdstitch.features import FeatureOptions


@pytest.mark.parametrize(("count", "share"), [(1, 4.0), (2, 4.0), (4, 2.0), (5, 1.6), (8, 1.0), (9, 1.0), (300, 1.0)])
def test_few_images_share_what_eight_would_have(count: int, share: float) -> None:
    features, megapixels = FeatureOptions().for_images(count).limits
    assert features == round(2000 * min(share, 2.0))
    assert abs(megapixels - 0.6 * share) < 1e-9


def test_what_is_given_is_kept() -> None:
    assert FeatureOptions(max_features=700).for_images(2).limits == (700, 2.4)
    assert FeatureOptions(work_megapixels=None).for_images(2).limits == (4000, None)
    assert FeatureOptions(work_megapixels=0.3).for_images(2).limits == (4000, 0.3)


def test_numbers_stay_what_they_are() -> None:
    """A run on seven of two images' options is that on two."""
    two = FeatureOptions().for_images(2)
    assert two.for_images(7) == two
