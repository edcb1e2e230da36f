"""Parameters of which a few run every time, and all with ``-m slow or not slow``."""

from collections.abc import Iterable
from typing import Any

import pytest


def sampled(values: Iterable[Any], count: int = 1) -> list[Any]:
    """The first ``count`` of the values, and the others marked as slow; a tuple holds the values of several names."""
    return [
        value
        if index < count
        else pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.slow)
        for index, value in enumerate(values)
    ]
