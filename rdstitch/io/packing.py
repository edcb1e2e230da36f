"""Values as bytes and back: dataclasses of arrays and plain values, exactly, and never believed when damaged.

A packed value is a magic word, the SHA-256 of the rest, a JSON text that describes the value, and the arrays that it
refers to. Nothing in it can name code to be run: only the dataclasses that the reader allows are made.
"""

import dataclasses
import hashlib
import json
import struct
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from rdstitch.errors import ArgumentError, InputError

_MAGIC = b"rdstitch pack 1\n"
_DIGEST = hashlib.sha256().digest_size
_HEAD = len(_MAGIC) + _DIGEST + 8
# What building a value from damaged bytes raises; NumPy parses the names of dtypes as Python, hence the first.
_DAMAGED = (
    *(SyntaxError, ValueError, TypeError, LookupError, AttributeError, RecursionError, OverflowError),
    struct.error,
)
_ARRAY_KINDS = "biuf"


def pack(value: Any) -> bytes:
    """A value as bytes; equal values give equal bytes.

    Parameters
    ----------
    value
        None, bool, int, float, str, Path, a numeric array, or a tuple, list, dict with text keys, or dataclass of
        these.

    Raises
    ------
    ArgumentError
        When there is anything else in it.
    """
    blocks: list[bytes] = []
    text = json.dumps(_describe(value, blocks), sort_keys=True).encode("ascii")
    body = struct.pack("<Q", len(text)) + text + b"".join(blocks)
    return _MAGIC + hashlib.sha256(body).digest() + body


def unpack(data: bytes, kinds: Iterable[type] = ()) -> Any:
    """The value that :func:`pack` made bytes of.

    Parameters
    ----------
    kinds : iterable of dataclass
        What may be made.

    Raises
    ------
    InputError
        When the bytes are damaged, or hold something else.
    """
    body = data[len(_MAGIC) + _DIGEST :]
    if not data.startswith(_MAGIC) or hashlib.sha256(body).digest() != data[len(_MAGIC) : len(_MAGIC) + _DIGEST]:
        raise InputError("damaged: it is not what was written")
    try:
        (length,) = struct.unpack_from("<Q", body)
        if 8 + length > len(body):
            raise ValueError("it ends too early")
        arrays = memoryview(body)[8 + length :]
        return _build(json.loads(body[8 : 8 + length]), arrays, {kind.__name__: kind for kind in kinds})
    except _DAMAGED as error:
        raise InputError(f"not what was expected: {error}") from error


def digest(value: Any) -> str:
    """A short text that stands for a value as :func:`pack` takes it: equal for equal values only."""
    return hashlib.sha256(pack(value)).hexdigest()


def _describe(value: Any, blocks: list[bytes]) -> Any:
    """The JSON that stands for a value; arrays go to the blocks."""
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        # As text: NaN and infinity are no JSON, and hexadecimal digits are exact.
        return {"float": value.hex()}
    if isinstance(value, np.generic):
        return _describe(value.item(), blocks)
    if isinstance(value, np.ndarray):
        return _describe_array(value, blocks)
    if isinstance(value, Path):
        return {"path": str(value)}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _describe(getattr(value, f.name), blocks) for f in dataclasses.fields(value)}
        return {"object": type(value).__name__, "fields": fields}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_describe(item, blocks) for item in value]}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {"dict": {key: _describe(item, blocks) for key, item in sorted(value.items())}}
    raise ArgumentError(f"a {type(value).__name__} cannot be packed")


def _describe_array(array: NDArray[Any], blocks: list[bytes]) -> Any:
    if array.dtype.kind not in _ARRAY_KINDS:
        raise ArgumentError(f"an array of {array.dtype} cannot be packed")
    # Sums depend on the order in memory in their last bits: it is kept.
    order: Literal["C", "F"] = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
    blocks.append(array.tobytes(order))
    return {"array": array.dtype.str, "shape": list(array.shape), "order": order}


_hints_of = cache(get_type_hints)
"""Of a dataclass; to read them takes longer than to build it."""


def is_of(value: Any, hint: Any) -> bool:
    """Whether a value is what it is declared as, such as a field of a dataclass, as far as that can be seen."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return value in arguments
    if origin in (Union, UnionType):
        return any(is_of(value, part) for part in arguments)
    if origin is tuple and isinstance(value, tuple):
        if arguments[1:] == (...,):
            return all(is_of(item, arguments[0]) for item in value)
        return len(value) == len(arguments) and all(map(is_of, value, arguments))
    if origin is list and isinstance(value, list):
        return all(is_of(item, arguments[0]) for item in value)
    if hint is float:
        return isinstance(value, (float, int)) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    kind = origin or hint
    return not isinstance(kind, type) or isinstance(value, kind)


def _build(described: Any, blocks: memoryview, kinds: dict[str, type]) -> Any:
    """The value that a description stands for. Arrays are taken from the blocks in the order of the description."""
    position = 0

    def build(part: Any) -> Any:
        nonlocal position
        if not isinstance(part, dict):
            if isinstance(part, (list, float)):
                raise TypeError("a bare list or number")
            return part
        if "array" in part:
            dtype, shape = np.dtype(str(part["array"])), tuple(int(n) for n in part["shape"])
            if dtype.kind not in _ARRAY_KINDS or any(n < 0 for n in shape):
                raise ValueError(f"an array of {dtype} and shape {shape}")
            size = dtype.itemsize * int(np.prod(shape, dtype=object))
            block = blocks[position : position + size]
            position += size
            order: Literal["C", "F"] = "F" if part["order"] == "F" else "C"
            return np.ndarray(shape, dtype, buffer=block, order=order).copy(order="K")
        if "object" in part:
            # In the order of the fields, as they were packed.
            kind = kinds[part["object"]]
            given = part["fields"]
            values = {f.name: build(given[f.name]) for f in dataclasses.fields(kind)}
            for name, hint in _hints_of(kind).items():
                if name in values and not is_of(values[name], hint):
                    raise TypeError(f"{kind.__name__}.{name} is a {type(values[name]).__name__}")
            return kind(**values)
        ((name, content),) = part.items()
        if name == "dict":
            return {key: build(item) for key, item in content.items()}
        if name in ("tuple", "list"):
            items = [build(item) for item in content]
            return tuple(items) if name == "tuple" else items
        if name == "path":
            return Path(content)
        if name != "float":
            raise ValueError(f"a {name}")
        return float.fromhex(content)

    value = build(described)
    if position != len(blocks):
        raise ValueError("bytes left over")
    return value
