"""What leaving out a picture or a pair can heal, and what it would only hide."""

from dataclasses import replace
from pathlib import Path

import pytest

from rdstitch.cache import NO_CACHE
from rdstitch.executors import open_executor
from rdstitch.features import FeatureOptions
from rdstitch.inputs.source import read_sources
from rdstitch.messages import Message, Severity, left_out
from rdstitch.options import StitchOptions
from rdstitch.pipeline.accept import _concerns_all, _Offenders, _without
from rdstitch.pipeline.aligner import Aligner
from rdstitch.pipeline.register import register
from tests.cli.running import flight


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


def test_pairs_that_contradicted_what_is_left_out_are_judged_again(tmp_path: Path) -> None:
    """The pair of the other two pictures had been dropped for contradicting the third one, and 0 with it."""
    frames = flight(3, 3).write(tmp_path)
    sources, _ = read_sources(frames, camera=None, focal=380.0, distortion=None, skip_bad=False)
    options = StitchOptions(workers=1, features=FeatureOptions(max_features=600))
    with open_executor(1, len(sources)) as executor:
        found = register(sources, options, executor, skip_bad=False)
    links = tuple(replace(fit, used=2 in (fit.image1, fit.image2)) for fit in found.alignment.links)
    spoiled = replace(
        found,
        alignment=replace(found.alignment, links=links, used=found.alignment.used & [False, True, True]),
        messages=(left_out(frames[0], "contradicts"),),
    )
    rest = _without(
        spoiled, _Offenders({2: Message("shows something else")}, {}), Aligner.of(sources, options, NO_CACHE)
    )
    assert rest is not None
    assert rest.alignment.used.tolist() == [True, True, False]
    assert [str(message) for message in rest.left_out] == [f"left out {frames[2]}: shows something else [left-out]"]
