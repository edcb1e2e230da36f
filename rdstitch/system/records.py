"""JSON, YAML and XML as records: values are checked by their types, complaints name the file and the field."""

import json
import math
import re
from collections.abc import Callable
from typing import Annotated, Any, TypeVar
from xml.etree import ElementTree

import msgspec
import numpy as np
from msgspec import Meta

from rdstitch.errors import InputError

_DEEPEST = 50  # objects and lists within one another
_MAX_YAML = 2**20  # characters
_MIN_ENTRY, _MAX_ENTRY = 1e-30, 1e30  # of matrices

Kind = TypeVar("Kind")
Count = Annotated[int, Meta(ge=0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Positive = Annotated[float, Meta(gt=0.0)]
Side = Annotated[int, Meta(ge=1, le=10**7)]
Size = Annotated[tuple[Side, Side], Meta(description="width and height, px")]
Pair = tuple[float, float]
Triple = tuple[float, float, float]
Matrix = Annotated[tuple[Triple, Triple, Triple], Meta(description="3 x 3, row by row")]


def parse_json(text: str, file: str) -> Any:
    """JSON text as plain values; ``file`` is what messages call it.

    Numbers that are not finite, NUL characters and deep nesting are refused, wherever they are.
    """
    try:
        value = json.loads(text)
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"{file}: is not JSON: {error.msg} at {where}") from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"{file}: is not JSON that can be read: {error}") from error
    return _checked(value, file)


def parse_yaml(text: str, file: str) -> Any:
    """YAML text as plain values, also as OpenCV writes it; see :func:`parse_json`."""
    import yaml

    class Loader(yaml.SafeLoader):
        """Knows OpenCV's matrices, which are objects; and no merge keys, by which a few lines become millions."""

        def flatten_mapping(self, node: Any) -> None:
            pass

    for kind in ("opencv-matrix", "opencv-nd-matrix"):
        Loader.add_constructor(f"tag:yaml.org,2002:{kind}", yaml.SafeLoader.construct_yaml_map)  # type: ignore[type-var]
    if len(text) > _MAX_YAML:
        raise InputError(f"{file}: is too large for a camera file")
    try:
        # OpenCV's directive has a colon where the standard has a space; ROS prints one document after the other.
        first = next(yaml.load_all(re.sub(r"^%YAML:.*", "", text), Loader), None)
        return _checked(first, file)
    except yaml.MarkedYAMLError as error:
        line = 0 if error.problem_mark is None else error.problem_mark.line + 1
        raise InputError(f"{file}: line {line}: is not YAML: {error.problem}; no camera file?") from error
    except (yaml.YAMLError, RecursionError, ValueError, TypeError, LookupError) as error:
        raise InputError(f"{file}: is not YAML that can be read: {error}") from error


def parse_xml(text: str, file: str) -> ElementTree.Element:
    """The root of XML text whose tags are without their namespaces."""
    if "<!ENTITY" in text:
        raise InputError(f"{file}: defines entities, which are not read; remove them")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{file}: is not XML: {error}") from error
    for item in root.iter():
        item.tag = item.tag.rpartition("}")[2]
    return root


def convert(value: Any, kind: Callable[..., Kind], file: str, field: str = "", *, strict: bool = True) -> Kind:
    """Plain values as a record; ``field`` is where in the file they are; unless ``strict``, texts are numbers too."""
    try:
        return msgspec.convert(value, kind, strict=strict)  # type: ignore[no-any-return]
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at `$")
        if missing := re.fullmatch(r"Object missing required field `(.*)`", problem):
            path, problem = f"{path.rstrip('`')}.{missing[1]}", "is missing"
        place = (field + path.rstrip("`")).lstrip(".")
        if not problem[1:2].isupper():  # as of EPSG
            problem = problem[:1].lower() + problem[1:]
        raise InputError(": ".join(filter(None, (file, place, problem)))) from error
    except (UnicodeError, OverflowError) as error:
        raise InputError(f"{file}: cannot be read: {error}") from error


def to_jsonable(value: Any) -> Any:
    """Records as plain JSON values: arrays are lists, paths texts, and what is not finite is null."""
    return _finite(msgspec.to_builtins(value, enc_hook=lambda item: getattr(item, "tolist", item.__str__)()))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_invertible(matrix: tuple[Triple, Triple, Triple], name: str) -> None:
    """Refuse a matrix that has no inverse, or of which products are no numbers."""
    largest = float(np.abs(matrix).max())
    if not (_MIN_ENTRY <= largest <= _MAX_ENTRY and np.linalg.cond(np.array(matrix) / largest) < 1e12):
        raise ValueError(f"{name} is singular, or not of reasonable size")


def _checked(value: Any, file: str) -> Any:
    containers: list[tuple[str, int, Any]] = [("", 1, {"": value})]
    seen = set[int]()  # aliases of YAML are one object at many places: a few lines can hold millions
    while containers:
        field, depth, container = containers.pop()
        if depth > _DEEPEST:
            raise InputError(f"{file}: {field}: is nested too deeply")
        for key, item in container.items() if isinstance(container, dict) else enumerate(container):
            name = f"{field}[{key}]" if isinstance(container, list) else f"{field}.{key}".lstrip(".")
            if isinstance(item, float) and not math.isfinite(item):
                raise InputError(f"{file}: {name}: expected a finite number, not {item}")
            if isinstance(item, str) and "\0" in item:  # which no system takes as part of a name
                raise InputError(f"{file}: {name}: holds a NUL character")
            if isinstance(item, (dict, list)) and id(item) not in seen:
                seen.add(id(item))
                containers.append((name, depth + 1, item))
    return value
