"""Which findings are said aloud."""

from dataclasses import replace

import pytest

from rdstitch.messages import Message
from rdstitch.verification.rules import MAX_WARNINGS, Situation, spoken

GOOD = Situation(alike=0.8, flat=True, depth=False, shape_doubtful=False)
RELIEF, SHAPE, PARALLAX = (Message(code, ("a.jpg",), code=code) for code in ("relief", "shape", "parallax"))
RIVAL = Message("a vehicle?", ("a.jpg",), code="rival-motion")


def _said(*messages: Message, found: Situation = GOOD) -> list[str]:
    return [message.code for message in spoken(messages, found) if message.severity == "warning"]


def test_what_is_not_said_is_a_detail() -> None:
    (note,) = spoken([PARALLAX], GOOD)
    assert note == replace(PARALLAX, severity="detail")


@pytest.mark.parametrize("code", ["relief", "parallax"])
def test_of_a_turn_and_of_pairs_only_what_is_seen_is_said(code: str) -> None:
    message, turned = Message(code, code=code), replace(GOOD, flat=False, depth=True)
    assert _said(message, found=turned) == []
    assert _said(message, found=replace(turned, alike=0.1)) == [code]


def test_of_a_plane_one_line_says_that_it_may_be_none() -> None:
    rough = replace(GOOD, depth=True)
    assert _said(RELIEF, found=rough) == ["relief"]
    assert _said(RELIEF, SHAPE, found=replace(rough, shape_doubtful=True)) == ["shape"]
    assert _said(SHAPE) == []


def test_depth_is_no_vehicle() -> None:
    assert _said(RIVAL, found=replace(GOOD, flat=False, depth=True)) == []
    assert _said(RIVAL) == ["rival-motion"]


def test_a_seam_among_trees_is_no_doubtful_one() -> None:
    seam = Message("only 8 of 61 places look alike", ("a.jpg", "b.jpg"), code="doubtful-seam")
    assert _said(seam) == ["doubtful-seam"]
    assert _said(seam, found=replace(GOOD, depth=True)) == []


def test_failures_and_images_left_out_stay() -> None:
    given = [Message("no", (), "failure", "relief"), Message("no", ("a.jpg",), "left out")]
    assert list(spoken(given, replace(GOOD, flat=False))) == given


def test_there_are_a_few_lines_of_a_run_the_gravest_first_and_one_of_a_kind() -> None:
    others = [Message(str(number), code=f"other-{number}") for number in range(MAX_WARNINGS)]
    assert _said(RIVAL, *others) == [other.code for other in others]
    assert _said(others[0], replace(others[0], text="again")) == ["other-0"]
    assert len(spoken([RIVAL, *others, *others], GOOD)) == 1 + 2 * MAX_WARNINGS
