"""Options of matching are checked before long work begins."""

import pytest

from rdstitch.errors import ArgumentError
from rdstitch.matching.options import MatchingOptions, PairOptions
from rdstitch.robust import SOLVERS


def test_unknown_solvers_are_refused_with_the_known_ones() -> None:
    with pytest.raises(ArgumentError, match=r"unknown solver 'six_point'; choose one of auto, two_point"):
        PairOptions(solver="six_point")
    assert [PairOptions(solver=name).solver for name in SOLVERS] == list(SOLVERS)


def test_pairs_are_estimated_with_the_defaults_of_the_whole() -> None:
    assert MatchingOptions().pair == PairOptions()
