"""How wide hills are shows in how far errors agree."""

import numpy as np
import pytest

from rdstitch.alignment.relief_field import _spectrum

LEFT = np.array([[1.0, 1.0, 1.0, 1.0], [0.2, 0.6, 0.9, 1.0], [-0.2, 0.1, 0.5, 0.9]])
"""Agreement at three distances that four bands of waves leave, from short to long ones."""


@pytest.mark.parametrize("band", range(4))
def test_the_band_that_errors_agree_like_is_found(band: int) -> None:
    power = _spectrum(LEFT, 0.5 * LEFT[:, band], np.full(3, 1e-4))
    assert power[band] > 0.3
    np.testing.assert_allclose(LEFT @ power, 0.5 * LEFT[:, band], atol=0.03)


def test_where_errors_do_not_tell_waves_are_equally_steep() -> None:
    np.testing.assert_allclose(_spectrum(LEFT, np.array([0.5, 0.3, 0.3]), np.full(3, 1e3)), 0.125, rtol=1e-3)


def test_without_agreement_there_are_no_hills() -> None:
    np.testing.assert_array_equal(_spectrum(LEFT, np.array([-0.1, 0.0, 0.0]), np.full(3, 0.1)), 0.0)
