"""Options, messages, and the guide that explains them."""

import re
from pathlib import Path
from typing import Any, get_args

import pytest
from rdstitch_cli.help_pages import troubleshooting

from rdstitch import StitchOptions, errors
from rdstitch.alignment import LENSES, MODELS
from rdstitch.choices import LensName, ModelName, ProjectionName
from rdstitch.compositing.projection import PROJECTIONS
from rdstitch.errors import ArgumentError
from rdstitch.results.messages import Message, left_out, merge_by_reason
from rdstitch.verification.findings import Kind
from rdstitch.verification.verdict import RefusedError


def test_images_left_out_for_one_reason_are_named_together() -> None:
    blurred, alone = Message("is blurred", ("b/1.jpg",)), "no overlap"
    first, last = left_out("a/1.jpg", alone), left_out("a/3.jpg", alone)
    told = merge_by_reason([blurred, first, left_out("a/2.jpg", "in block 2"), last, blurred, first])
    assert list(map(str, told)) == [
        "1.jpg: is blurred",
        "left out a/1.jpg, 3.jpg: no overlap [left-out]",
        "left out a/2.jpg: in block 2 [left-out]",
        "1.jpg: is blurred",
    ]

    # The folder is named where it changes, and the temporary one of a video is not.
    (message,) = merge_by_reason([left_out(path, "no overlap") for path in ("a/1.jpg", "a/2.jpg", "b/1.jpg")])
    assert str(message) == "left out a/1.jpg, 2.jpg, b/1.jpg: no overlap [left-out]"
    assert str(left_out("/tmp/rdstitch-x1.part/drive_0003.jpg", "is blurred")).startswith("left out drive_0003.jpg: ")


_ROOT = Path(__file__).parents[3]


def test_every_code_has_a_paragraph_and_every_paragraph_a_code() -> None:
    headings = re.findall(r"(?m)^### (\S+)$", (_ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8"))
    of_errors = {kind.code for kind in vars(errors).values() if isinstance(kind, type) and hasattr(kind, "code")}
    sources = [path.read_text(encoding="utf-8") for path in (_ROOT / "rdstitch").rglob("*.py")]
    of_messages = {code for text in sources for code in re.findall(r'code ?= ?"([a-z-]+)"', text)}
    of_messages |= {kind.code for kind in Kind}
    assert {RefusedError.code, "relief", "lambda-not-observable"} <= of_messages
    assert sorted(headings) == sorted((of_errors | of_messages) - {""})
    assert sorted(troubleshooting()) == sorted(headings)


def test_codes_end_the_line() -> None:
    assert str(Message("hazy", code="relief")) == "hazy [relief]"
    assert str(Message("hazy")) == "hazy"
    assert str(left_out("a.jpg", "is damaged")) == "left out a.jpg: is damaged [left-out]"


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"solver": "twenty_point"}, "twenty_point"),
        ({"model": "wavy"}, "wavy"),
        ({"lens": "glass"}, "glass"),
        ({"lens": "division2", "distortion": -0.1}, "known lens"),
        ({"solver": "two_point"}, "tilt"),
        ({"solver": "five_point", "distortion": -0.1}, "known λ"),
        ({"distortion": 1.0}, "distortion must be a number above -1 and below 1"),
        ({"focal": 0.0}, "focal must be a number above 0"),
        ({"attitude_std": -1.0}, "attitude_std must be a number, radians, from 0"),
        ({"confidence": 1.0}, "confidence"),
        ({"local_alignment": 1}, "local_alignment must be auto or off or a whole number from 2 to 100"),
        ({"scheduler": "tcp://somewhere:8786"}, "--cache"),
        ({"seed": -1}, "seed must be a whole number of at least 0"),
        ({"workers": 10**20}, "workers must be a whole number from 0 to 1024"),
    ],
)
def test_what_contradicts_itself_is_refused(wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(ArgumentError, match=named):
        StitchOptions(**wrong)


def test_the_types_name_what_there_is() -> None:
    assert get_args(LensName) == ("auto", *LENSES)
    assert get_args(ModelName) == ("auto", *MODELS)
    assert get_args(ProjectionName) == ("auto", *PROJECTIONS)
