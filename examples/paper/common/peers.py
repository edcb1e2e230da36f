"""Other libraries, where they are installed; a figure does without those that are not."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.solvers import Solutions


def optional_module(name: str) -> Any | None:
    """A module, or None where it is not installed."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        return None


def absent(*names: str) -> tuple[str, ...]:
    """A note for each of the modules that is not installed."""
    return tuple(f"{name} is not installed and was left out" for name in names if optional_module(name) is None)


def homlib_solver(name: str, *arguments: bool) -> Callable[[FloatArray, FloatArray], Solutions] | None:
    """A minimal solver of homlib with rdstitch's calling convention, or None where homlib is not installed.

    It is called once a sample, as homlib has no batches.
    """
    homlib = optional_module("homlib")
    if homlib is None:
        return None
    estimate = getattr(homlib, name)

    def solve(x1: FloatArray, x2: FloatArray) -> Solutions:
        columns = np.ascontiguousarray(np.swapaxes(np.stack([x1, x2]), -1, -2))
        # Of noisy points its solvers sometimes return a homography of NaN.
        found = [
            [model for model in estimate(a, b, *arguments) if np.isfinite(model.homography).all()]
            for a, b in zip(*columns, strict=True)
        ]
        counts = [len(models) for models in found]
        models = [model for own in found for model in own]
        return Solutions(
            np.repeat(np.arange(len(found)), counts),
            np.array([model.homography for model in models]).reshape(-1, 3, 3),
            np.array([model.distortion_parameter for model in models]).reshape(-1),
        )

    return solve
