"""What all benchmarks share: their command line, and measurements of time and memory.

``python -m examples.benchmarks.NAME --help`` lists the options of each.
"""

import inspect
import json
import os
import resource
import subprocess
import sys
import time
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import click

from rdstitch.system.process_memory import forget_peak_memory, peak_memory

_IMPORTED = "rdstitch_cli.commands.mosaic, rdstitch.pipeline.recipes, scipy.sparse.linalg, scipy.spatial"


def run(benchmark: Callable[..., None]) -> None:
    """Call a function with what the command line gives: its positional parameters, and an option for each keyword."""
    hints = typing.get_type_hints(benchmark)
    parameters = [_parameter(parameter, hints[name]) for name, parameter in _signature(benchmark).items()]
    positional = [name for name, p in _signature(benchmark).items() if p.kind is not p.KEYWORD_ONLY]

    def call(**given: Any) -> None:
        first = [given.pop(name) for name in positional]
        _keep_byte_code()
        benchmark(*first, **given)

    click.Command("benchmark", params=parameters, callback=call, help=benchmark.__globals__["__doc__"])()


def _keep_byte_code() -> None:
    """Have what is timed compiled before, as installed programs are, and have other programs keep what they compile."""
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    subprocess.run([sys.executable, "-c", f"import {_IMPORTED}"], check=True)


def _signature(benchmark: Callable[..., None]) -> dict[str, inspect.Parameter]:
    return dict(inspect.signature(benchmark).parameters)


def _parameter(parameter: inspect.Parameter, hint: Any) -> click.Parameter:
    """The option or argument of a parameter; a tuple of values may be given one by one."""
    if typing.get_origin(hint) is types.UnionType:
        hint = next(kind for kind in typing.get_args(hint) if kind is not types.NoneType)
    several = typing.get_origin(hint) is tuple
    hint = typing.get_args(hint)[0] if several else hint
    kind: Any = click.Choice(typing.get_args(hint)) if typing.get_origin(hint) is Literal else hint
    kind = click.Path(path_type=Path) if hint is Path else kind
    required = parameter.default is parameter.empty
    default = None if required else parameter.default
    if parameter.kind is not parameter.KEYWORD_ONLY:
        return click.Argument(
            [parameter.name], type=kind, nargs=-1 if several else 1, required=required, default=default
        )
    name = parameter.name.replace("_", "-")
    flag = f"--{name}/--no-{name}" if default is True else f"--{name}"
    return click.Option([flag], type=kind, is_flag=hint is bool, multiple=several, default=default, show_default=True)


def images_of(folder: Path) -> list[Path]:
    """The image files of a folder, in the order of their names."""
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)


SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}


def apart(benchmark: str, *arguments: str) -> dict[str, Any]:
    """What a benchmark that runs in a process of its own, so that memory is its own, prints last as JSON."""
    command = [sys.executable, "-m", f"examples.benchmarks.{benchmark}", *arguments]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    row: dict[str, Any] = json.loads(printed.splitlines()[-1])
    return row


def costliest(values: dict[str, float], count: int = 8) -> str:
    """The stages that cost most, and what."""
    most = sorted(values.items(), key=lambda stage: -stage[1])[:count]
    return ", ".join(f"{stage} {value:.1f}" for stage, value in most)


def processor_time() -> float:
    """Of this process since it began, its threads and the processes that it has ended included, s."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Processor seconds, and the result."""
    begun = time.process_time()
    result = work()
    return time.process_time() - begun, result


@dataclass
class StagePeaks:
    """Most memory that was held in each stage, MB; a progress of recipes. Linux only."""

    held: dict[str, float] = field(default_factory=dict)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """What was held since the last report belongs to the stage that now reports."""
        self.held[stage] = max(self.held.get(stage, 0.0), peak_memory())
        forget_peak_memory()


@dataclass
class StageTimes:
    """Seconds until each stage last reported, of this process or by another clock; a progress of recipes."""

    clock: Callable[[], float] = time.process_time
    spent: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.begun = self.clock()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """What has passed since the last report belongs to the stage that now reports."""
        now = self.clock()
        self.spent[stage] = self.spent.get(stage, 0.0) + now - self.begun
        self.begun = now
