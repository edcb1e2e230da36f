"""Records of files that others wrote."""

import re

import pytest

from rdstitch.errors import InputError
from rdstitch.system.records import parse_json


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": ["b", {"c": "x\\u0000y"}]}', "r.json: a[1].c: holds a NUL character"),
        ('{"a": [1, NaN]}', "r.json: a[1]: expected a finite number, not nan"),
        ("[" * 60 + "]" * 60, "is nested too deeply"),
        ("{", "r.json: is not JSON: "),
    ],
)
def test_what_no_record_may_hold_is_named(text: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        parse_json(text, "r.json")
