"""How the result was made: when, by which command, with which options."""

from dataclasses import fields, is_dataclass
from datetime import datetime
from importlib.metadata import version
from typing import Any

from rdstitch.options import StitchOptions
from rdstitch.report.svg import section, table


def run(options: StitchOptions | None, command: str) -> str:
    """Date, version, command line, and the options that are not the defaults."""
    rows = [("date", datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")), ("rdstitch", version("rdstitch"))]
    if command:
        rows.append(("command", command))
    if options is not None:
        changed = _changed(options, type(options)())
        rows.append(("options", "; ".join(changed) if changed else "all as usual"))
    return section("Run", "", table((), rows))


def _changed(options: Any, defaults: Any, prefix: str = "") -> list[str]:
    """``name = value`` of every option that differs."""
    found = []
    for field in fields(options):
        value, default = getattr(options, field.name), getattr(defaults, field.name)
        if is_dataclass(value) and type(value) is type(default):
            found += _changed(value, default, f"{prefix}{field.name}.")
        elif value != default:
            found.append(f"{prefix}{field.name} = {value}")
    return found
