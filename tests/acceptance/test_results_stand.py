"""Results of a few real and rendered sets, to the fourth digit of λ: what a refactoring must leave as it is.

README's example is compared in tests/cli/test_documents.py. A change that is meant to move these says why.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import rdstitch


@pytest.mark.parametrize(
    ("name", "recipe", "model", "distortion", "images", "size"),
    [
        ("cases/robot_drive", rdstitch.mosaic, "rigid", -0.2101, 18, (603, 973)),
        ("cases/survey_tilt", rdstitch.mosaic, "similarity", -0.0500, 12, (1104, 905)),
        ("classical/DHW-temple", rdstitch.pano, "homography", 0.0, 2, (1281, 648)),
    ],
)
def test_a_result_is_what_it_was(
    name: str,
    recipe: Callable[..., rdstitch.StitchResult],
    model: str,
    distortion: float,
    images: int,
    size: tuple[int, int],
    shared_data: Callable[[str], Path],
) -> None:
    result = recipe([shared_data(name)], options=rdstitch.StitchOptions(workers=1, dry_run=True))
    alignment = result.registration.alignment
    assert result.ok
    assert (alignment.model, int(alignment.used.sum())) == (model, images)
    assert alignment.distortion == pytest.approx(distortion, abs=1e-4)
    np.testing.assert_allclose(result.canvas.size, size, atol=2)
