"""What is said of a motion other than the plane's, by the area that it covers."""

import math

import pytest

from rdstitch.verification.rival_motion import RivalMotion, rival_messages, rival_share

PATHS = ("folder/a.png", "folder/b.png")


def _rival(area: int, plane: int) -> RivalMotion:
    return RivalMotion(0, 1, area, plane, (30.0, 40.0), 120.0)


@pytest.mark.parametrize(
    ("area", "agreement", "severity"),
    [
        (9, 0.9, None),
        (9, 0.2, None),
        (11, 0.9, "warning"),
        (11, math.nan, "warning"),
        (11, 0.39, "failure"),
        (44, 0.41, "warning"),
        (46, 0.9, "failure"),
    ],
)
def test_area_and_agreement_decide(area: int, agreement: float, severity: str | None) -> None:
    messages = rival_messages(PATHS, [_rival(area, 100 - area)], agreement)
    assert [message.severity for message in messages] == ([] if severity is None else [severity])


def test_the_place_is_named() -> None:
    (message,) = rival_messages(PATHS, [_rival(10, 90), _rival(30, 70)], 0.8)
    assert message.images == PATHS
    for part in ("20%", "(30, 40) of a.png", "b.png", "120 pixels"):
        assert part in message.text


def test_a_rival_does_not_spoil_the_lens() -> None:
    (message,) = rival_messages(PATHS, [_rival(60, 40)], 0.1, lens_only=True)
    assert message.severity == "warning"


def test_the_share_is_of_all_pairs_together() -> None:
    assert rival_share([_rival(0, 60), _rival(30, 10)]) == 0.3
    assert rival_share([]) == 0.0
