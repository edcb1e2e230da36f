"""What leaving out an image or a pair can heal, and what it would only hide."""

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
from rdstitch.messages import Message, left_out
from rdstitch.options import StitchOptions
from rdstitch.pipeline.accept import _without, accept
from rdstitch.pipeline.aligner import AlignedPairs, Aligner
from rdstitch.pipeline.register import register
from rdstitch.verification.verdict import RefusedError
from tests.cli.running import flight

OPTIONS = StitchOptions(workers=1, features=FeatureOptions(max_features=600))


def _read(frames: list[Path]) -> list[Source]:
    return read_sources(frames, camera=None, focal=380.0, distortion=None, skip_bad=False)[0]


def test_pairs_that_contradicted_what_is_left_out_are_judged_again(tmp_path: Path) -> None:
    """The pair of the other two images had been dropped for contradicting the third one, and 0 with it."""
    frames = flight(3, 3).write(tmp_path)
    sources = _read(frames)
    with open_executor(1, len(sources)) as executor:
        found = register(sources, OPTIONS, executor)
    links = tuple(replace(fit, used=2 in (fit.image1, fit.image2)) for fit in found.alignment.links)
    spoiled = replace(
        found,
        alignment=replace(found.alignment, links=links, used=found.alignment.used & [False, True, True]),
        messages=(left_out(frames[0], "contradicts"),),
    )
    rest = _without(spoiled, {(2,): Message("shows something else")}, Aligner.of(sources, OPTIONS, NO_CACHE))
    assert rest.alignment.used.tolist() == [True, True, False]
    assert [str(message) for message in rest.left_out] == [f"left out {frames[2]}: shows something else [left-out]"]


def test_what_remains_has_metric_poses_where_they_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def aligned(aligner: Aligner, pairs: object) -> Any:
        asked.append(aligner.options.model)
        found: Any = SimpleNamespace(poses=None if aligner.options.model == "auto" else "poses", on_sphere=False)
        return AlignedPairs((), found)

    monkeypatch.setattr(Aligner, "_drafted", aligned)
    monkeypatch.setattr("rdstitch.pipeline.aligner.over_rough_ground", lambda pairs, threshold: pairs)
    free = Aligner.of([], OPTIONS, NO_CACHE)
    assert free.align(()).alignment.poses is None
    assert replace(free, needs_poses=True).align(()).alignment.poses is not None
    assert asked == ["auto", "auto", "pose"]


def test_of_two_motions_that_which_fills_more_of_the_overlaps_is_taken(tmp_path: Path) -> None:
    """What drives ahead fills a good third of every image, and has more matches where images overlap little."""
    plane, ahead = flight(3, 3, overlap=0.4), flight(5, 3, overlap=0.4)
    middle = ahead.poses.position.mean(axis=0)
    slow = middle + 0.15 * (ahead.poses.position - middle) + [[0.0, 25.0], [0.0, -25.0], [0.0, 25.0]]
    ahead = replace(ahead, poses=replace(ahead.poses, position=slow))
    frames = plane.write(tmp_path)
    for k, frame in enumerate(frames):
        write_image(frame, np.concatenate([plane.frame(k)[:192], ahead.frame(k)[192:]]))
    sources = _read(frames)
    with open_executor(1, len(sources)) as executor:
        found = register(sources, OPTIONS, executor)
        accepted = accept(found, OPTIONS)
    steps = [np.diff(k.alignment.homographies[:, 0, 2]) for k in (found, accepted)]
    assert np.all(np.abs(steps[0]) < 0.2)  # heights above the ground: what drives ahead moves by a sixth
    assert np.all(np.abs(steps[1]) > 0.7)
    (message,) = (message for message in accepted.messages if message.severity != "detail")
    assert (message.code, message.severity) == ("rival-motion", "warning")


def test_what_the_alignment_itself_fails_by_is_refused(tmp_path: Path) -> None:
    """Such as depth that looks like a lens, of a calibration."""
    sources = _read(flight(2, 2).write(tmp_path))
    with open_executor(1, len(sources)) as executor:
        found = register(sources, OPTIONS, executor).with_messages([Message("no lens shows", severity="failure")])
        with pytest.raises(RefusedError, match="no lens shows"):
            accept(found, OPTIONS)
        assert not accept(found, replace(OPTIONS, force=True)).ok
