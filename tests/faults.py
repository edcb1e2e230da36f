"""A file system that fails at a chosen moment: the n-th rename, fsync or write of whatever runs."""

import builtins
import errno
import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import pytest

Operation = Literal["rename", "fsync", "write", "mkdir"]
OPERATIONS: tuple[Operation, ...] = ("rename", "fsync", "write", "mkdir")

_FUNCTIONS = {"rename": ("rename", "replace", "link"), "fsync": ("fsync",), "mkdir": ("mkdir",), "write": ()}


class FailingDisk:
    """Counts operations of one kind, and fails the one of a number.

    ``failing``: number of the operation that fails, from 0; None for none.
    """

    def __init__(self, operation: Operation, failing: int | None = None) -> None:
        self.operation, self.failing, self.count = operation, failing, 0

    def step(self) -> None:
        self.count += 1
        if self.count - 1 == self.failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextmanager
def failing_disk(operation: Operation, failing: int | None = None) -> Iterator[FailingDisk]:
    """Let the n-th operation of a kind fail inside the block."""
    disk = FailingDisk(operation, failing)
    with pytest.MonkeyPatch.context() as patch:
        for name in _FUNCTIONS[operation]:
            patch.setattr(os, name, _failing(disk, getattr(os, name)))
        if operation == "write":
            opened = _failing_open(disk)
            patch.setattr(builtins, "open", opened)
            patch.setattr(io, "open", opened)
        yield disk


def _failing(disk: FailingDisk, function: Any) -> Any:
    def call(*arguments: Any, **options: Any) -> Any:
        disk.step()
        return function(*arguments, **options)

    return call


def _failing_open(disk: FailingDisk) -> Any:
    """``open`` whose binary files for writing fail; others are as usual."""
    usual = io.open

    class FailingFile(io.FileIO):
        def write(self, data: Any) -> int:
            disk.step()
            return super().write(data)

    def call(file: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        if "b" not in mode or not set(mode) & set("wxa+") or not isinstance(file, (str, Path)):
            return usual(file, mode, *arguments, **options)
        raw = FailingFile(os.fspath(file), mode.replace("b", ""), opener=options.get("opener"))
        return io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)

    return call
