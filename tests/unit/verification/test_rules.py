"""The rules of the verdict, and their thresholds."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rdstitch.alignment.result import LinkFit, Unused
from rdstitch.choices import Purpose
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.source import Source
from rdstitch.io.mask import Mask
from rdstitch.matching.mixed_lenses import TwoLenses
from rdstitch.results.messages import Message
from rdstitch.verification import rules
from rdstitch.verification.evidence import ResultEvidence
from rdstitch.verification.findings import Finding, Kind, messages_of
from rdstitch.verification.overlap_check import CheckedLink
from rdstitch.verification.photometric_agreement import Agreement
from rdstitch.verification.self_similarity import Ambiguity
from rdstitch.verification.verdict import _limit_warnings, _outvoted, failures_of_matches
from tests.registrations import CAMERA, evidence, finding, registration, source

FLAT = evidence(registration(), alike_fraction=0.8)


def _depth(alike: float, purpose: Purpose = Purpose.TRAJECTORY, size: float = 0.0, **alignment: Any) -> ResultEvidence:
    """Of images whose errors neighbours share."""
    relief = replace(registration().alignment.relief, found=True, size=size)
    return evidence(registration(relief=relief, **alignment), purpose, alike_fraction=alike, checked=[])


@pytest.mark.parametrize(
    ("found", "warned"),
    [
        (_depth(0.8, model="rotation"), []),  # of a turn and of pairs only what is seen
        (_depth(0.1, model="rotation"), [Kind.DEPTH_OF_A_TURN]),
        (_depth(0.8), [Kind.RELIEF]),
        (_depth(0.8, parameters=()), [Kind.FREE_HOMOGRAPHIES]),  # one line: the plane may be none
        (_depth(0.8, Purpose.CALIBRATE, parameters=()), [Kind.RELIEF]),  # of a lens nothing adds up
        (_depth(0.1, Purpose.MOSAIC, model="rotation", rms=4.0), []),
        # What local alignment hides along the seams of a plane leaves the whole bent.
        (_depth(0.8, Purpose.MOSAIC, rms=4.0), [Kind.ROUGH]),
        (_depth(0.8, Purpose.MOSAIC, size=1.01), [Kind.RELIEF]),  # a third of the threshold
        (_depth(0.8, Purpose.MOSAIC, size=0.99), []),
    ],
)
def test_of_what_is_not_flat_the_gravest_warns_where_it_matters(found: ResultEvidence, warned: list[Kind]) -> None:
    findings = _limit_warnings(rules.findings(rules.OF_THE_WHOLE, found))
    assert [finding.kind for finding in findings if finding.severity == "warning"] == warned
    assert any(finding.kind in (Kind.RELIEF, Kind.DEPTH_OF_A_TURN) for finding in findings)


def test_there_are_a_few_lines_of_a_run_and_one_of_a_kind() -> None:
    failures = finding(Kind.ERRORS), finding(Kind.IMAGE_MISFITS, (1,))
    assert _limit_warnings(failures) == failures
    kinds = [Kind.UNMASKED, Kind.UNMASKED, Kind.ZOOMED, Kind.TWO_OF_ONE_LENS, Kind.SETTLED_PATTERN]
    limited = _limit_warnings(finding(kind, (0, 1), "warning") for kind in kinds)
    assert [each.severity for each in limited] == ["warning", "detail", "warning", "warning", "detail"]


def test_whoever_judges_keeps_to_the_table_of_rules() -> None:
    """A board shifted by a square is as straight as before: no pair of a calibration fails by where it lies."""
    misfits = (LinkFit(0, 1, 100, 90, 0.5), LinkFit(1, 2, 100, 90, 0.5), LinkFit(2, 3, 40, 4, 0.5))
    kinds = {
        purpose: {
            finding.kind
            for finding in failures_of_matches(evidence(registration(4, links=misfits, keypoints=(900,) * 4), purpose))
        }
        for purpose in (Purpose.CALIBRATE, Purpose.TRAJECTORY)
    }
    assert kinds == {Purpose.CALIBRATE: set(), Purpose.TRAJECTORY: {Kind.PAIR_MISFITS}}


def _fitting(share: float) -> tuple[LinkFit, ...]:
    return tuple(LinkFit(i, j, 100, int(100 * share), 0.5) for i, j in ((0, 1), (1, 2)))


def test_every_kind_has_a_sentence_that_its_rules_find_all_words_for() -> None:
    rough, lenses = replace(FLAT.alignment.relief, found=True), np.array([False, True, False])
    checked = [_checked(0.05, (0, 1), unique=False), _checked(0.9, (1, 2), unique=True)]
    sampled = [replace(_checked(0.9, (k, k + 1), unique=False), sampled=True) for k in range(30)]
    ahead = replace(checked[0], agreement=Agreement(80, 8, 100, 0.35))
    cameras = [source("a.jpg", model="A"), source("b.jpg", model="B", mask=Mask(Path("m"))), source("c.jpg", model="B")]
    zoomed = [
        source(f"{name}.jpg", model="A", focal_px=focal) for name, focal in zip("abc", (9.0, 9.0, 7.0), strict=True)
    ]
    everything = [
        evidence(
            registration(
                mixed=TwoLenses(lenses, (-0.1, -0.4), certain=False), links=_fitting(0.2), keypoints=(9, 9, 9)
            ),
            checked=[],
        ),
        evidence(
            registration(links=_fitting(0.55), keypoints=(9, 9, 9)), checked=checked, ambiguous={(0, 1): checked[0]}
        ),
        evidence(registration(rms=4.0), alike_fraction=0.1, checked=[ahead]),
        evidence(registration(rms=4.0, relief=rough, parameters=()), alike_fraction=0.9, checked=sampled),
        evidence(registration(model="rotation", relief=rough), alike_fraction=0.1, checked=[]),
        evidence(registration(mixed=TwoLenses(lenses, (-0.1, -0.4), certain=True), used=~lenses), checked=[]),
        evidence(registration(cameras), checked=[]),
        evidence(registration(zoomed), checked=[]),
    ]
    found = [
        (each, rules.findings((*rules.OF_MATCHES, *rules.OF_PAIRS, *rules.OF_THE_WHOLE), each)) for each in everything
    ]
    found.append((FLAT, _outvoted([finding(Kind.UNLIKE, (0, 1)), finding(Kind.AMBIGUOUS, (1, 2))])))
    assert {finding.kind for _, findings in found for finding in findings} == set(Kind)
    texts = [message.text for each, findings in found for message in messages_of(findings, each.registration)]
    assert not any("{" in text for text in texts)


@pytest.mark.parametrize(
    ("purpose", "coarse", "severity"),
    [
        (Purpose.TRAJECTORY, 0.35, ["failure"]),
        (Purpose.TRAJECTORY, 0.45, []),
        (Purpose.TRAJECTORY, np.nan, []),
        (Purpose.MOSAIC, 0.35, []),
        (Purpose.CALIBRATE, 0.35, []),
    ],
)
def test_poses_by_what_fills_less_than_half_of_the_images_are_none(
    purpose: Purpose, coarse: float, severity: list[str]
) -> None:
    """A truck that drives ahead, say: four fifths of the images lie over each other, and most of that is unlike."""
    link = replace(_checked(0.1, (0, 1), unique=False), agreement=Agreement(80, 8, 100, coarse))
    found = rules.findings(rules.OF_THE_WHOLE, evidence(registration(), purpose, checked=[link]))
    assert [finding.severity for finding in found if finding.kind is Kind.RIVAL_MOTION] == severity


@pytest.mark.parametrize(
    ("purpose", "alike", "placed"),
    [
        (Purpose.MOSAIC, (15, 100), True),
        (Purpose.MOSAIC, (5, 100), False),
        (Purpose.TRAJECTORY, (15, 100), False),
        # Of few cells as many are alike in 44, 15, 41 and 5 of 100 wrong places.
        (Purpose.MOSAIC, (1, 8), False),
        (Purpose.MOSAIC, (2, 10), False),
        (Purpose.MOSAIC, (2, 20), False),
        (Purpose.MOSAIC, (4, 20), False),
        (Purpose.MOSAIC, (4, 8), True),
    ],
)
def test_matches_of_a_picture_may_disagree_where_it_is_more_alike_than_by_chance(
    purpose: Purpose, alike: tuple[int, int], placed: bool
) -> None:
    """Depth, or what moved: seams go round it, or are told of; poses have nothing but their matches."""
    given = registration(2, links=(LinkFit(0, 1, 100, 40, 0.5),), keypoints=(900, 900))
    confirming, cells = alike
    link = replace(_checked(0.0, (0, 1), unique=False), agreement=Agreement(cells, confirming, cells, 0.6))
    found = evidence(given, purpose, checked=[link])
    assert bool(failures_of_matches(found)) is not placed


def _found(given: ResultEvidence, *kinds: Kind) -> list[Finding]:
    """Findings of some kinds, of images whose pixels say nothing unless they are given."""
    vars(given).setdefault("checked", [])
    every = rules.findings((*rules.OF_MATCHES, *rules.OF_PAIRS, *rules.OF_THE_WHOLE), given)
    return [finding for finding in every if finding.kind in kinds]


def _misfits(count: int, *, agree: float = 0.2, keypoints: tuple[int, ...] = (900, 900, 900)) -> list[Message]:
    """What is said of two images with so many matches, of which a share agrees with the alignment."""
    fit = LinkFit(0, 1, count, int(agree * count), 0.5)
    given = registration(2, keypoints=keypoints, links=(fit,))
    found = evidence(given)
    return messages_of(_found(found, Kind.PAIR_MISFITS, Kind.IMAGE_MISFITS), given)


@pytest.mark.parametrize(
    ("count", "keypoints", "reason"),
    [
        (39, 900, "too few to place it: little overlap, or none? stitch them on their own"),
        (41, 900, "another surface, or come from another camera or zoom? stitch them on their own"),
        (41, 200, "b.jpg has less than a third of the features that others have"),
    ],
)
def test_a_pair_whose_matches_agree_with_each_other_only_is_named(count: int, keypoints: int, reason: str) -> None:
    (message,) = _misfits(count, keypoints=(900, keypoints, 900))
    assert message.images == ("folder/a.jpg", "folder/b.jpg")
    assert message.text.startswith("a.jpg and b.jpg: only ")
    assert reason in message.text


def test_images_of_whose_matches_two_fifths_disagree_are_named() -> None:
    first, second = _misfits(100, agree=0.55, keypoints=(900, 200, 900))
    assert "only 55 of 100 of its matches fit the place that was found for it; they fit each other" in first.text
    assert "b.jpg has less than a third of the features that others have (blurred?)" in second.text
    assert second.images == ("folder/b.jpg",)
    assert _misfits(100, agree=0.65) == []


@pytest.mark.parametrize("inliers", [20, 55, 65])
def test_a_copy_is_judged_by_its_own_matches(inliers: int) -> None:
    links = LinkFit(0, 1, 100, 90, 0.5), LinkFit(0, 2, 100, inliers, 0.5, Unused.COPY)
    found = _found(evidence(registration(3, links=links, keypoints=(900,) * 3)), Kind.IMAGE_MISFITS)
    assert [finding.images for finding in found] == [(2,)] * (inliers < 60)


def _texts(*sources: Source) -> list[str]:
    given = registration(sources)
    found = _found(evidence(given), Kind.SEVERAL_CAMERAS, Kind.ZOOMED, Kind.UNMASKED)
    return [message.text for message in messages_of(found, given)]


@pytest.mark.parametrize("other", [{"model": "B"}, {"model": "B", "serial": "1"}, {"make": "X", "model": "A"}])
def test_several_cameras_are_named_the_commonest_first(other: dict[str, Any]) -> None:
    (text,) = _texts(source("z.jpg", **other), *(source(f"{k}.jpg", model="A") for k in range(2)))
    assert text.startswith("the images come from 2 cameras: A (2: 0.jpg, 1.jpg); ")
    assert "(1: z.jpg); stitch those of each on their own" in text


def test_images_of_one_camera_are_fine_a_serial_number_is_enough_and_no_header_is_no_camera() -> None:
    one = [source(f"{k}.jpg", model="A", serial="1", focal_px=900.0) for k in range(3)]
    edited = source("edited.jpg", model="A")
    assert _texts(*one) == _texts(*one, edited) == []
    (text,) = _texts(*one, edited, source("other.jpg", model="A", serial="2"))
    assert text.startswith("the images come from 2 cameras: A 1 (3: 0.jpg, 1.jpg, 2.jpg); A 2 (1: other.jpg); ")
    assert _texts(source("a"), source("b")) == _texts() == []
    assert len(_texts(source("a", serial="1"), source("b", serial="2"))) == 1
    assert _texts(source("a", serial="1"), source("b", make="X")) == []


@pytest.mark.parametrize(("focal", "zoomed"), [(925.0, False), (930.0, True), (870.0, True)])
def test_a_lens_that_was_zoomed_is_noticed(focal: float, zoomed: bool) -> None:
    """By more than three per cent, of which one is rounding."""
    found = _texts(source("a.jpg", model="A", focal_px=900.0), source("b.jpg", model="A", focal_px=focal))
    assert bool(found) is zoomed
    if zoomed:
        near, far = ("a.jpg", "b.jpg") if focal > 900 else ("b.jpg", "a.jpg")
        ratio = max(focal, 900.0) / min(focal, 900.0)
        assert f"by up to {ratio:.2f} (between {near} and {far})" in found[0]


@pytest.mark.parametrize(
    ("size", "focal_px", "focal_mm", "zoomed"),
    [
        ((4000, 2250), 2546.0, 8.8, False),  # crops whose tag of 35 mm, 24, was left as it is
        ((3000, 3000), 2353.0, 8.8, False),
        ((2000, 1500), 1387.0, 12.8, True),
        ((4000, 3000), 5547.0, 8.8, True),  # by the camera's program
        ((3000, 4000), 3200.0, None, True),
        ((4000, 2250), 3200.0, None, False),  # a crop, or not: nobody knows
    ],
)
def test_a_crop_is_no_zoom(size: tuple[int, int], focal_px: float, focal_mm: float | None, zoomed: bool) -> None:
    first, second = (
        source("a.jpg", focal_px=2773.0, focal_mm=8.8),
        source("b.jpg", focal_px=focal_px, focal_mm=focal_mm),
    )
    headers = replace(first.metadata, size=(4000, 3000)), replace(second.metadata, size=size)
    sources = [replace(each, metadata=header) for each, header in zip((first, second), headers, strict=True)]
    assert bool(_texts(*sources)) is zoomed


def test_images_without_a_mask_among_others_are_named() -> None:
    masked = [source(f"{k}.png", mask=Mask(Path("m"))) for k in range(3)]
    assert _texts(*masked) == []
    assert _texts(*masked, source("x.png")) == ["1 of 4 images have no mask: x.png"]
    assert _texts(masked[0], source("x.png"), source("y.png")) == ["2 of 3 images have no mask: x.png, y.png"]


@pytest.mark.parametrize(("relief", "severity"), [(True, "warning"), (False, "detail")])
def test_free_homographies_are_doubted_where_neighbours_errors_agree(relief: bool, severity: str) -> None:
    ground = replace(FLAT.alignment.relief, found=relief)
    found = evidence(registration(parameters=(), relief=ground))
    assert [finding.severity for finding in _found(found, Kind.FREE_HOMOGRAPHIES)] == [severity]
    assert not _found(evidence(registration(2, parameters=(), relief=ground)), Kind.FREE_HOMOGRAPHIES)


def test_where_no_pair_is_used_nothing_is_said_of_the_worst() -> None:
    """Of images that are all copies of one, say."""
    ground = replace(FLAT.alignment.relief, found=True)
    found = evidence(registration(links=(), parameters=(), relief=ground, rms=np.nan), Purpose.MOSAIC)
    assert not _found(found, Kind.FREE_HOMOGRAPHIES, Kind.ROUGH, Kind.ERRORS, Kind.RELIEF)


LARGEST = 0.02 * 500.0  # pixels that relief explains, of images with a diagonal of 500


@pytest.mark.parametrize(
    ("rms", "alike", "relief", "kind"),
    [
        (2.99, 0.0, None, None),
        (3.0, 0.0, None, None),  # the definition of an inlier, 3 pixels here
        (3.01, 0.24, None, Kind.ERRORS),
        (3.01, 0.25, None, Kind.ROUGH),
        (9.0, 0.25, None, Kind.ROUGH),  # three thresholds
        (9.01, 0.9, None, Kind.ERRORS),
        (9.01, 0.5, 9.0, Kind.ROUGH),  # what neighbours have in common left out, it is a plane
        (9.01, 0.49, 9.0, Kind.ERRORS),
        (9.5, 0.9, 9.02, Kind.ROUGH),  # 9.5² - 9.02² = 8.9
        (9.5, 0.9, 9.01, Kind.ERRORS),  # 9.07: more than 3²
        (LARGEST, 0.9, 9.9, Kind.ROUGH),
        (LARGEST + 0.01, 0.9, 9.9, Kind.ERRORS),
        (np.nan, 0.9, None, Kind.ERRORS),
    ],
)
def test_errors_of_the_whole(rms: float, alike: float, relief: float | None, kind: Kind | None) -> None:
    ground = replace(registration().alignment.relief, found=relief is not None, size=relief or 0.0)
    cameras = (CAMERA, Camera((40, 30)), CAMERA)
    found = evidence(registration(rms=rms, relief=ground, cameras=cameras), alike_fraction=alike)
    findings = _found(found, Kind.ERRORS, Kind.ROUGH)
    assert [finding.kind for finding in findings] == ([] if kind is None else [kind])
    for each in findings:
        assert each.severity == ("warning" if kind == Kind.ROUGH else "failure")
        assert each.values == pytest.approx({"rms": rms, "threshold": 3.0}, nan_ok=True)


def _checked(share: float, pair: tuple[int, int], *, unique: bool) -> CheckedLink:
    agreement = Agreement(100, round(100 * share))
    return CheckedLink(LinkFit(*pair, 9, 9, 0.5), agreement, Ambiguity(1, 0, 0), unique)


def test_of_pairs_that_unique_places_decided_the_least_alike_is_named() -> None:
    seen = [_checked(share, (k, k + 1), unique=k < 2) for k, share in enumerate((0.5, 0.3, 0.1))]
    (finding,) = _found(evidence(registration(4), checked=seen), Kind.PATTERN, Kind.SETTLED_PATTERN)
    assert (finding.kind, finding.images) == (Kind.SETTLED_PATTERN, (1, 2))


@pytest.mark.parametrize("certain", [True, False])
def test_images_of_two_lenses_that_were_not_separated(certain: bool) -> None:
    mixed = TwoLenses(np.array([False, True, False]), (-0.1, -0.4), certain)
    findings = _found(evidence(registration(mixed=mixed)), Kind.LENSES_MIXED)
    values = {"images2": (1,), "images1": (0, 2), "lens2": -0.4, "lens1": -0.1}
    assert [finding.values for finding in findings] == ([] if certain else [values])
