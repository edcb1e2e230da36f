"""Peaks between samples."""

import numpy as np
import pytest

from rdstitch.numerics.parabola import parabola_peak


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
def test_the_place_of_a_peak_does_not_depend_on_the_unit_of_its_values(unit: float) -> None:
    x = np.array([-1.0, 0.0, 1.0])
    place, height = parabola_peak(*(unit * (5.0 - 2.0 * (x - 0.3) ** 2)))
    assert place == pytest.approx(0.3)
    assert height == pytest.approx(5.0 * unit)
    assert parabola_peak(*np.array([250, 255, 250], dtype=np.uint8))[0] == 0.0


def test_values_without_a_curve_are_as_high_as_they_are() -> None:
    """Where rounding leaves no curvature of a peak, too."""
    lowest = np.nextafter(0.7, 0.0)
    place, height = parabola_peak([0.7, lowest, 0.7, 0.0], [0.7, 0.7, 0.7, 20.0], [0.7, 0.7, lowest, 40.0])
    assert np.abs(place).max() <= 0.5
    assert height == pytest.approx([0.7, 0.7, 0.7, 25.0])
