"""Stitch images of a flat scene taken through a lens that bends straight lines, without knowing the lens.

Homography and division-model distortion λ are estimated together from the images themselves. The names below are
loaded when they are first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import Any

# The names and where they live, as they are in the stub that type checkers read: from HOME import NAME as NAME
_lines = __loader__.get_data(f"{__path__[0]}/__init__.pyi").decode().splitlines()
_HOMES = {line.split()[3]: line.split()[1] for line in _lines if line.startswith("from ")}

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    """Load a public name from its home."""
    if name == "__version__":
        return import_module("importlib.metadata").version(__name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if _HOMES[name] == __name__:
        return import_module(f"{__name__}.{name}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return [*__all__, "__version__", "__doc__", "__all__"]
