"""The verdict on registered images, and what parallax tells it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.worlds.turns import camera_rotations, turning_sequence
from rdstitch.alignment.result import LinkFit
from rdstitch.choices import Purpose
from rdstitch.features import FeatureOptions
from rdstitch.geometry.camera import Camera
from rdstitch.io.write import write_image
from rdstitch.matching.mixed_lenses import TwoLenses
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.recipes import pano
from rdstitch.results.messages import Message
from rdstitch.results.registration import Registration
from rdstitch.synthetic import Photometry
from rdstitch.verification import verdict
from rdstitch.verification.evidence import ResultEvidence
from rdstitch.verification.findings import Finding, Kind, messages_of
from rdstitch.verification.overlap_check import CheckedLink
from rdstitch.verification.photometric_agreement import Agreement
from rdstitch.verification.self_similarity import Ambiguity
from tests.cli.running import flight
from tests.registrations import evidence, finding, registered, registration

THRESHOLD = 3.0


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Registration:
    """Three images in a chain, rightly registered."""
    frames = flight(3, 3).write(tmp_path_factory.mktemp("good"))
    return registered(frames, StitchOptions(workers=1, features=FeatureOptions(max_features=600)))


def judge(registration: Registration, threshold: float, purpose: Purpose = Purpose.MOSAIC) -> tuple[Message, ...]:
    """What is found, in words."""
    return tuple(messages_of(verdict.judge(ResultEvidence(registration, threshold, purpose=purpose)), registration))


def _texts(registration: Registration, purpose: Purpose = Purpose.MOSAIC) -> list[str]:
    return [m.clause for m in judge(registration, THRESHOLD, purpose) if m.severity == "failure"]


def _moved(good: Registration, image: int, shift: float) -> Registration:
    """An image put elsewhere on the plane, by a share of the half diagonal; its matches say what they said."""
    homographies = good.alignment.homographies.copy()
    move = np.eye(3)
    move[:2, 2] = shift * 0.6, shift * 0.8
    homographies[image] = homographies[image] @ move
    return replace(good, alignment=replace(good.alignment, homographies=homographies))


def test_what_was_not_named_is_counted(good: Registration) -> None:
    failures = [Message(f"reason {k}", severity="failure", kind=str(k)) for k in range(5)]
    assert "reason 0; reason 1; reason 2; and 2 more (" in str(verdict.RefusedError(good.with_messages(failures)))


@pytest.mark.parametrize("shift", [0.03, 0.05])
def test_images_that_do_not_look_alike_where_they_are_put_fail(good: Registration, shift: float) -> None:
    """However well their matches agree: repeated structure does that."""
    assert judge(good, THRESHOLD) == ()
    found = _texts(_moved(good, 2, shift))
    assert any("do not look alike where they are put together" in text for text in found)
    # Of the lens it says nothing.
    assert _texts(_moved(good, 2, shift), Purpose.CALIBRATE) == []


def test_a_wrong_pair_beside_enough_right_ones_is_a_warning(good: Registration) -> None:
    """Here image 2 is held by a pair that is right, and another is called wrong by its matches."""
    used = [fit for fit in good.alignment.links if fit.used]
    closing = replace(used[0], image1=0, image2=2, count=100, inliers=40)
    doubled = replace(good, alignment=replace(good.alignment, links=(*used, closing)))
    messages = judge(doubled, THRESHOLD)
    assert not any(message.severity == "failure" for message in messages)
    assert any("one pair fits badly" in message.text for message in messages)


@pytest.mark.parametrize(("share", "fails"), [(0.45, True), (0.55, False)])
def test_matches_of_which_less_than_half_agree_fail(good: Registration, share: float, fails: bool) -> None:
    links = tuple(replace(fit, count=1000, inliers=int(1000 * share)) for fit in good.alignment.links)
    disagreeing = replace(good, alignment=replace(good.alignment, links=links))
    for purpose in (Purpose.CALIBRATE, Purpose.TRAJECTORY):
        found = _texts(disagreeing, purpose)
        assert any("matches fit the places that were found" in text for text in found) is fails
    assert any("stitch them on their own" in text for text in found) is fails


def test_a_picture_whose_overlaps_look_alike_stands_whatever_its_matches_say(good: Registration) -> None:
    """Depth moves them; where the images are put together wrongly, pixels say so too."""
    links = tuple(replace(fit, count=1000, inliers=300) for fit in good.alignment.links)
    deep = replace(good, alignment=replace(good.alignment, links=links, rms=5 * THRESHOLD))
    assert _texts(deep) == []
    assert _texts(deep, Purpose.TRAJECTORY) != []
    assert _texts(_moved(deep, 2, 0.05)) != []


def test_images_without_texture_are_not_called_unlike(good: Registration, tmp_path: Path) -> None:
    """Where there is nothing to compare, nothing speaks against the matches."""
    sources = []
    for source in good.sources:
        width, height = source.camera.image_size
        path = tmp_path / source.name
        write_image(path, np.full((height, width, 3), 128, np.uint8))
        sources.append(replace(source, path=path))
    found = _texts(_moved(replace(good, sources=tuple(sources)), 2, 0.3))
    assert not any("do not look alike" in text for text in found)


def _checked(cells: int, confirming: int, *, pair: tuple[int, int] = (0, 1), elsewhere: float = 0.0) -> CheckedLink:
    fit = LinkFit(*pair, 100, 90, 0.5)
    return CheckedLink(fit, Agreement(cells, confirming, 10 * cells), Ambiguity(0.9, elsewhere, 0.25))


CHAIN = tuple(LinkFit(k, k + 1, 100, 90, 0.5) for k in range(2))


def _judged(*checked: CheckedLink, purpose: Purpose = Purpose.TRAJECTORY, **known: Any) -> list[Message]:
    """What is said of three images in a chain, whose pixels say this."""
    given = registration(**{"links": CHAIN, **known})
    return messages_of(verdict.judge(evidence(given, purpose, checked=list(checked))), given)


@pytest.mark.parametrize(("purpose", "severity"), [(Purpose.TRAJECTORY, "warning"), (Purpose.MOSAIC, "detail")])
def test_relief_names_the_pair_where_it_is_largest(purpose: Purpose, severity: str) -> None:
    """Of a picture its seams say more."""
    relief = replace(registration().alignment.relief, found=True)
    (message,) = _judged(purpose=purpose, relief=relief, links=(CHAIN[0], replace(CHAIN[1], rms=9.0)))
    assert message.severity == severity
    assert "between b.jpg and c.jpg (9.0 pixels)" in message.text


@pytest.mark.parametrize(
    ("cells", "confirming", "severity"), [(100, 9, "failure"), (100, 10, None), (7, 0, None), (8, 0, "failure")]
)
def test_a_tenth_of_an_overlap_must_look_alike(cells: int, confirming: int, severity: str | None) -> None:
    """Chance lets seven per cent agree; below eight cells there is too little texture."""
    found = _judged(_checked(cells, confirming))
    assert [message.severity for message in found] == ([] if severity is None else [severity])
    assert all(f"({confirming} of {cells}" in message.text for message in found)


@pytest.mark.parametrize(("coarse", "picture", "poses"), [(0.8, 0, 1), (0.4, 1, 1)])
def test_depth_shifts_what_a_picture_shows_by_a_little(coarse: float, picture: int, poses: int) -> None:
    """Few cells agree to 2.5 pixels then, but most at a coarse scale."""
    checked = _checked(100, 6)
    checked = replace(checked, agreement=replace(checked.agreement, coarse_similarity=coarse))
    said = [len(_judged(checked, purpose=purpose)) for purpose in (Purpose.MOSAIC, Purpose.TRAJECTORY)]
    assert said == [picture, poses]


@pytest.mark.parametrize(("ambiguous", "of_all"), [(1, False), (2, True)])
def test_a_pattern_all_over(ambiguous: int, of_all: bool) -> None:
    """Of more than two fifths of the pairs."""
    pairs = [(0, 1), (1, 2), (0, 2)]
    checked = [_checked(100, 90, pair=pair, elsewhere=0.9 * (k < ambiguous)) for k, pair in enumerate(pairs)]
    found = _judged(*checked)
    assert any(f"{ambiguous} of 3 pairs fit as well elsewhere" in message.text for message in found) is of_all
    assert any("25% of an image away" in message.text for message in found)


def test_what_only_the_places_suffer_from_is_not_said_of_a_lens() -> None:
    """There are no seams to look at."""
    checked = _checked(100, 90, elsewhere=0.9), _checked(100, 5, pair=(1, 2))
    assert _judged(*checked, purpose=Purpose.CALIBRATE) == []


def test_only_pairs_without_which_the_images_fall_apart_decide() -> None:
    used = [LinkFit(i, j, 100, 90, 0.5) for i, j in ((0, 1), (1, 2), (0, 2), (2, 3))]
    assert verdict.decisive_pairs({(0, 1)}, used, 4) == []
    assert verdict.decisive_pairs([(0, 1), (2, 3)], used, 4) == [(2, 3)]
    assert verdict.decisive_pairs([(0, 1), (0, 2)], used, 4) == [(0, 1), (0, 2)]
    assert verdict.decisive_pairs([], used, 4) == []


def test_of_doubtful_pairs_on_which_nothing_depends_the_images_are_named() -> None:
    def said(*findings: Finding) -> list[Message]:
        return messages_of(verdict._outvoted(findings), registration(4))

    (message,) = said(finding(Kind.UNLIKE, (2, 3)), finding(Kind.PAIR_MISFITS, (0, 2)))
    assert message.images == ("folder/a.jpg", "folder/c.jpg", "folder/d.jpg")
    assert "2 pairs fit badly, and little depends on them: c.jpg and d.jpg, a.jpg and c.jpg" in message.text
    badly, twice = said(finding(Kind.UNLIKE, (2, 3)), finding(Kind.AMBIGUOUS, (0, 2)))
    assert "one pair fits badly, and little depends on it: c.jpg and d.jpg" in badly.text
    assert "one pair fits as well elsewhere (a repeated pattern?)" in twice.text
    assert twice.images == ("folder/a.jpg", "folder/c.jpg")
    assert said() == []


def test_two_images_that_are_left_of_one_lens_may_be_of_a_curved_wall() -> None:
    mixed = TwoLenses(np.array([False, False, True]), (-0.1, -0.2), certain=True)
    assert _judged(mixed=mixed) == []
    (message,) = _judged(mixed=mixed, links=CHAIN[:1], used=np.array([True, True, False]))
    assert message.severity == "warning"
    assert message.images == ("folder/a.jpg", "folder/b.jpg")


LENS = Camera((320, 240), -0.2, focal=260.0, focal_source="option")


def test_a_pure_turn_is_not_warned_of(tmp_path: Path) -> None:
    near = np.array([[-0.29, 0.02, 0.96, 0.4], [0.29, -0.03, 0.96, 0.4]]) * 0.45
    rotations = camera_rotations(np.radians([-35.0, 0.0, 35.0]), [0.03, -0.02, 0.01])
    sequence = turning_sequence(LENS, rotations, seed=7, photometry=Photometry(noise=0.005), near=near)
    registration = pano(sequence.write(tmp_path), options=StitchOptions()).registration
    assert registration.alignment.model == "rotation"
    assert not registration.messages
