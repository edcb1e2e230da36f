"""Places of one point by several measurements."""

from itertools import permutations

from rdstitch.geometry.places import contradicting_places


def test_contradicting_places_are_found_in_any_order() -> None:
    """One of 10 m agrees with both of two exact ones that are 16 m from each other."""
    for order in permutations([((0.0, 0.0), 10.0), ((8.0, 0.0), 0.001), ((-8.0, 0.0), 0.001)]):
        places, stds = zip(*order, strict=True)
        found = contradicting_places(["P"] * 3, places, stds)
        assert found is not None
        assert {places[k] for k in found[:2]} == {(8.0, 0.0), (-8.0, 0.0)}
        assert found[2] == 16.0
    assert contradicting_places(["P", "Q"], [(0.0, 0.0), (9.0, 0.0)], [None, None]) is None
