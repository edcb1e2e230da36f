"""What the agreement of neighbouring residuals says of the scene, whatever the size of the pictures."""

import pytest

from rdstitch.alignment.planarity import Coherence, judge_relief


@pytest.mark.parametrize(
    ("correlation", "relative_size", "found"),
    [(0.9, 0.001, True), (0.9, 0.0005, False), (0.4, 0.01, False), (0.51, 0.0008, True)],
)
def test_relief_needs_agreement_and_size(correlation: float, relative_size: float, found: bool) -> None:
    for diagonal in (500.0, 2000.0):
        relief = judge_relief(Coherence(correlation, relative_size * diagonal, relative_size, 3.0), "rigid")
        assert relief.found is found
        assert ("not one plane" in relief.explanation) is found
