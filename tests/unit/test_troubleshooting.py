"""docs/troubleshooting.md: every code that a message ends with has its paragraph, and no other."""

import re
from pathlib import Path

from rdstitch_cli.help_pages import troubleshooting

from rdstitch import errors
from rdstitch.messages import Message, left_out
from rdstitch.verification.messages import TEXTS
from rdstitch.verification.verdict import RefusedError

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
