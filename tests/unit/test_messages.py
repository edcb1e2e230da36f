"""Messages, and the guide that explains them."""

import re
from pathlib import Path

from rdstitch_cli.help_pages import troubleshooting

from rdstitch import errors
from rdstitch.messages import Message, left_out, told_once
from rdstitch.verification.messages import TEXTS
from rdstitch.verification.verdict import RefusedError


def test_images_left_out_for_one_reason_are_named_together() -> None:
    blurred, alone = Message("is blurred", ("b/1.jpg",)), "no overlap"
    first, last = left_out("a/1.jpg", alone), left_out("a/3.jpg", alone)
    told = told_once([blurred, first, left_out("a/2.jpg", "in block 2"), last, blurred, first])
    assert list(map(str, told)) == [
        "1.jpg: is blurred",
        "left out a/1.jpg, 3.jpg: no overlap [left-out]",
        "left out a/2.jpg: in block 2 [left-out]",
        "1.jpg: is blurred",
    ]


def test_the_folder_is_named_where_it_changes() -> None:
    (message,) = told_once([left_out(path, "no overlap") for path in ("a/1.jpg", "a/2.jpg", "b/1.jpg")])
    assert str(message) == "left out a/1.jpg, 2.jpg, b/1.jpg: no overlap [left-out]"


def test_the_temporary_folder_of_a_video_is_not_named() -> None:
    assert str(left_out("/tmp/rdstitch-x1.part/drive_0003.jpg", "is blurred")).startswith("left out drive_0003.jpg: ")


_ROOT = Path(__file__).parents[2]


def test_every_code_has_a_paragraph_and_every_paragraph_a_code() -> None:
    headings = re.findall(r"(?m)^### (\S+)$", (_ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8"))
    of_errors = {kind.code for kind in vars(errors).values() if isinstance(kind, type) and hasattr(kind, "code")}
    sources = [path.read_text(encoding="utf-8") for path in (_ROOT / "rdstitch").rglob("*.py")]
    of_messages = {code for text in sources for code in re.findall(r'code ?= ?"([a-z-]+)"', text)}
    of_messages |= {code for code, _ in TEXTS.values()}
    assert {RefusedError.code, "relief", "lambda-not-observable"} <= of_messages
    assert sorted(headings) == sorted((of_errors | of_messages) - {""})
    assert sorted(troubleshooting()) == sorted(headings)


def test_codes_end_the_line() -> None:
    assert str(Message("hazy", code="relief")) == "hazy [relief]"
    assert str(Message("hazy")) == "hazy"
    assert str(left_out("a.jpg", "is damaged")) == "left out a.jpg: is damaged [left-out]"
