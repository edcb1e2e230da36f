"""The part of YAML that OpenCV's FileStorage writes: fields, one level of nested fields, lists of numbers and texts.

OpenCV's own reader is not used: it says on standard error what it does not like, and crashes on some of it.
"""

import json
import re
from typing import Any

from rdstitch.errors import InputError
from rdstitch.records import Record, parse_json

_FIELD = re.compile(r"(?P<indent> *)(?P<key>[^\s:#\[\]{}\"']+) *:(?: +(?P<value>.*))?")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def to_yaml(content: dict[str, Any]) -> str:
    """Numbers, texts, lists and one level of objects as FileStorage writes them."""
    lines = ["%YAML:1.0", "---"]
    for key, value in content.items():
        if not isinstance(value, dict):
            lines.append(f"{key}: {_plain(value)}")
            continue
        matrix = value.get("type_id") == "opencv-matrix"
        lines.append(f"{key}: !!opencv-matrix" if matrix else f"{key}:")
        lines.extend(f"   {name}: {_plain(item)}" for name, item in value.items() if name != "type_id")
    return "\n".join(lines) + "\n"


def parse_yaml(text: str, file: str) -> Record:
    """What FileStorage wrote, as a record.

    Raises
    ------
    InputError
        When there is anything else in the text; the line is named.
    """
    content: dict[str, Any] = {}
    nested: dict[str, Any] | None = None
    for number, line in _logical_lines(text):
        match = _FIELD.fullmatch(line)
        if match is None:
            raise InputError(f"{file}: line {number}: is not what OpenCV writes as YAML; no camera file?")
        value = (match["value"] or "").strip()
        if match["indent"]:
            if nested is None:
                raise InputError(f"{file}: line {number}: belongs to no field")
            nested[match["key"]] = _value(value, file, number)
        elif value in ("", "!!opencv-matrix"):
            nested = content[match["key"]] = {}
        else:
            nested = None
            content[match["key"]] = _value(value, file, number)
    return Record(file, "", content)


def _logical_lines(text: str) -> list[tuple[int, str]]:
    """Lines with their numbers; lists that go on are one line, comments and document marks none."""
    lines: list[tuple[int, str]] = []
    opened = False
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.rstrip()
        if opened:
            lines[-1] = (lines[-1][0], f"{lines[-1][1]} {line.strip()}")
        elif line.strip() and not line.lstrip().startswith(("#", "%", "---", "...")):
            lines.append((number, line))
        else:
            continue
        opened = lines[-1][1].count("[") > lines[-1][1].count("]")
    return lines


def _value(text: str, file: str, number: int) -> Any:
    """A number, a list or a text; JSON's, and numbers like ``1.`` that OpenCV writes."""
    if text.startswith(("[", '"')):
        whole = _NUMBER.sub(lambda found: str(float(found[0])), text) if text.startswith("[") else text
        return parse_json(whole, f"{file}: line {number}").value
    return _number(text) if _NUMBER.fullmatch(text) else text


def _number(text: str) -> float | int:
    return int(text) if re.fullmatch(r"[-+]?\d{1,15}", text) else float(text)


def _plain(value: Any) -> str:
    return json.dumps(value)
