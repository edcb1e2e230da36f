"""What leaving out a picture or a pair can heal, and what it would only hide."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rdstitch.cache import NO_CACHE
from rdstitch.executors import open_executor
from rdstitch.features import FeatureOptions
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io import write_image
from rdstitch.messages import Message, Severity, left_out
from rdstitch.options import StitchOptions
from rdstitch.pipeline.accept import _concerns_all, _may_be_another_plane, _Offenders, _without, _without_damage, accept
from rdstitch.pipeline.aligner import Aligner
from rdstitch.pipeline.register import register
from tests.cli.running import flight

OPTIONS = StitchOptions(workers=1, features=FeatureOptions(max_features=600))


def _read(frames: list[Path]) -> list[Source]:
    return read_sources(frames, camera=None, focal=380.0, distortion=None, skip_bad=False)[0]


@pytest.mark.parametrize(
    ("images", "severity", "expected"),
    [
        (("a.png", "b.png", "c.png"), "failure", True),
        (("a.png", "b.png", "c.png"), "warning", False),
        (("a.png", "b.png"), "failure", False),
        (("a.png",), "failure", False),
        ((), "failure", False),
    ],
)
def test_only_failures_of_many_pictures_concern_all(
    images: tuple[str, ...], severity: Severity, expected: bool
) -> None:
    assert _concerns_all([Message("wrong", ("x.png",), "failure"), Message("wrong", images, severity)]) is expected


@pytest.mark.parametrize(
    ("images", "severity", "code", "expected"),
    [
        (("a.png",), "failure", "", False),
        (("a.png", "b.png"), "failure", "", False),
        ((), "warning", "", False),
        ((), "failure", "", True),
        (("a.png", "b.png"), "warning", "rival-motion", True),
    ],
)
def test_in_large_sets_a_second_motion_is_looked_for_where_it_may_be(
    images: tuple[str, ...], severity: Severity, code: str, expected: bool
) -> None:
    assert _may_be_another_plane([Message("wrong", images, severity, code)]) is expected


@pytest.mark.parametrize(
    ("former", "rest", "remaining", "left_out"),
    [
        ("tilting", "rigid", 3, True),
        ("homography", "tilting", 3, True),
        ("rigid", "rigid", 3, False),
        ("rigid", "tilting", 3, False),
        ("tilting", "rigid", 2, False),  # most of the pictures would be missing
        ("tilting", "rotation", 3, False),
    ],
)
def test_what_is_damaged_is_left_out_where_the_others_fit_a_simpler_motion(
    monkeypatch: pytest.MonkeyPatch, former: str, rest: str, remaining: int, left_out: bool
) -> None:
    def registration(model: str, used: int) -> Any:
        guard = SimpleNamespace(messages=[Message("is damaged", ("2.jpg",), code="damaged")])
        alignment = SimpleNamespace(model=model, used=np.arange(4) < used)
        return SimpleNamespace(
            alignment=alignment, sources=[SimpleNamespace(path=f"{k}.jpg", guard=guard) for k in range(4)]
        )

    whole, smaller = registration(former, 4), registration(rest, remaining)
    asked: list[_Offenders] = []

    def without(_: object, offenders: _Offenders, aligner: object) -> Any:
        asked.append(offenders)
        return smaller

    monkeypatch.setattr("rdstitch.pipeline.accept._without", without)
    aligner: Any = None
    assert _without_damage(whole, aligner) is (smaller if left_out else whole)
    assert [list(offenders.reasons) for offenders in asked] == [[2]]
    unused = registration(former, 2)  # the damaged one is not in it anyway
    assert _without_damage(unused, aligner) is unused


def test_pairs_that_contradicted_what_is_left_out_are_judged_again(tmp_path: Path) -> None:
    """The pair of the other two pictures had been dropped for contradicting the third one, and 0 with it."""
    frames = flight(3, 3).write(tmp_path)
    sources = _read(frames)
    with open_executor(1, len(sources)) as executor:
        found = register(sources, OPTIONS, executor, skip_bad=False)
    links = tuple(replace(fit, used=2 in (fit.image1, fit.image2)) for fit in found.alignment.links)
    spoiled = replace(
        found,
        alignment=replace(found.alignment, links=links, used=found.alignment.used & [False, True, True]),
        messages=(left_out(frames[0], "contradicts"),),
    )
    rest = _without(
        spoiled, _Offenders({2: Message("shows something else")}, {}), Aligner.of(sources, OPTIONS, NO_CACHE)
    )
    assert rest is not None
    assert rest.alignment.used.tolist() == [True, True, False]
    assert [str(message) for message in rest.left_out] == [f"left out {frames[2]}: shows something else [left-out]"]


def test_what_remains_has_metric_poses_where_they_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def aligned(aligner: Aligner, pairs: object, former: object) -> Any:
        asked.append(aligner.options.model)
        return SimpleNamespace(poses=None if aligner.options.model == "auto" else "poses", on_sphere=False)

    monkeypatch.setattr(Aligner, "_aligned", aligned)
    monkeypatch.setattr("rdstitch.pipeline.aligner.over_rough_ground", lambda pairs, threshold: pairs)
    free = Aligner.of([], OPTIONS, NO_CACHE)
    assert free.align(()).alignment.poses is None
    assert replace(free, needs_poses=True).align(()).alignment.poses is not None
    assert asked == ["auto", "auto", "pose"]


def test_of_two_motions_that_which_fills_more_of_the_overlaps_is_taken(tmp_path: Path) -> None:
    """What drives ahead fills a good third of every picture, and has more matches where pictures overlap little."""
    plane, ahead = flight(3, 3, overlap=0.4), flight(5, 3, overlap=0.4)
    middle = ahead.poses.position.mean(axis=0)
    slow = middle + 0.15 * (ahead.poses.position - middle) + [[0.0, 25.0], [0.0, -25.0], [0.0, 25.0]]
    ahead = replace(ahead, poses=replace(ahead.poses, position=slow))
    frames = plane.write(tmp_path)
    for k, frame in enumerate(frames):
        write_image(frame, np.concatenate([plane.frame(k)[:192], ahead.frame(k)[192:]]))
    sources = _read(frames)
    with open_executor(1, len(sources)) as executor:
        found = register(sources, OPTIONS, executor, skip_bad=False)
        accepted = accept(found, OPTIONS, executor)
    steps = [np.diff(k.alignment.homographies[:, 0, 2]) for k in (found, accepted)]
    assert np.all(np.abs(steps[0]) < 0.2)  # heights above the ground: what drives ahead moves by a sixth
    assert np.all(np.abs(steps[1]) > 0.7)
    (message,) = accepted.messages
    assert (message.code, message.severity) == ("rival-motion", "warning")
    assert "what was stitched fills" in message.text
