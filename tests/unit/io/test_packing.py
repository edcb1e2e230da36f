"""Values as bytes and back."""

import hashlib
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError, InputError, RdstitchError
from rdstitch.io import packing
from rdstitch.io.packing import digest, pack, unpack

_ARRAYS = hnp.arrays(
    st.sampled_from([np.dtype(kind) for kind in ("f8", "f4", "u1", "u2", "i8", "bool")]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)
_PLAIN = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(st.characters(codec=None)), _ARRAYS)
_VALUES = st.recursive(
    _PLAIN,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.tuples(inner, inner),
        st.dictionaries(st.text(max_size=3), inner, max_size=3),
    ),
    max_leaves=8,
)


def _same(first: Any, second: Any) -> bool:
    """Equal in type and in every bit."""
    if type(first) is not type(second):
        return False
    if isinstance(first, np.ndarray):
        return bool(first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes())
    if isinstance(first, float):
        return bool(first.hex() == second.hex())
    if isinstance(first, (list, tuple)):
        return len(first) == len(second) and all(map(_same, first, second))
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(_same(first[key], second[key]) for key in first)
    return bool(first == second)


@given(_VALUES)
def test_a_value_comes_back_in_every_bit(value: Any) -> None:
    assert _same(unpack(pack(value)), value)
    assert digest(unpack(pack(value))) == digest(value)


def test_dataclasses_come_back_where_they_are_expected() -> None:
    value = (Camera((400, 300), -0.2, focal=350.0), Path("a/b"), np.arange(6.0).reshape(2, 3).T)
    camera, path, turned = unpack(pack(value), [Camera])
    assert (camera, path) == value[:2]
    # The order in memory decides on the last bits of sums.
    assert turned.flags.f_contiguous
    with pytest.raises(InputError):
        unpack(pack(value))


def test_what_cannot_be_packed_is_refused() -> None:
    for value in (object(), {1: 2}, np.array(["text"]), {3}, b"bytes"):
        with pytest.raises(ArgumentError):
            pack(value)


def test_dictionaries_are_equal_in_any_order() -> None:
    first, second = {"a": np.zeros(2), "b": np.ones(2)}, {"b": np.ones(2), "a": np.zeros(2)}
    assert digest(first) == digest(second)
    assert digest(first) != digest({"a": np.ones(2), "b": np.zeros(2)})


@given(st.data())
def test_damage_is_noticed(data: st.DataObject) -> None:
    packed = pack({"camera": Camera((400, 300), -0.2), "points": np.arange(40.0)})
    where = data.draw(st.integers(0, len(packed) - 1))
    damaged = bytearray(packed)
    damaged[where] ^= data.draw(st.integers(1, 255))
    for bad in (bytes(damaged), packed[:where], packed + b"x"):
        with pytest.raises(InputError):
            unpack(bad, [Camera])


@dataclass(frozen=True)
class _Whole:
    """Stands for any dataclass."""

    number: int


@given(st.binary(max_size=200))
def test_what_has_the_right_digest_but_was_not_packed_is_refused_or_a_value(body: bytes) -> None:
    """A description of a value, "null" for one, may come about by chance; it then stands for that value."""
    for inner in (body, struct.pack("<Q", len(body)) + body, struct.pack("<Q", 2**63)):
        forged = packing._MAGIC + hashlib.sha256(inner).digest() + inner
        try:
            value = unpack(forged, [_Whole, Camera])
        except RdstitchError:
            continue
        assert _same(unpack(pack(value), [_Whole, Camera]), value)


@pytest.mark.parametrize("inner", [b"", struct.pack("<Q", 2**63), struct.pack("<Q", 3) + b"{x}", b"12345678null"])
def test_what_only_pretends_is_refused(inner: bytes) -> None:
    with pytest.raises(RdstitchError):
        unpack(packing._MAGIC + hashlib.sha256(inner).digest() + inner)


@pytest.mark.parametrize(
    "text",
    [
        '{"object": "os.system", "fields": {}}',
        '{"object": "_Whole", "fields": {}}',
        '{"array": "O", "shape": [1], "order": "C"}',
        '{"array": "<f8", "shape": [1000000000000], "order": "C"}',
        '{"array": "<f8", "shape": [-1], "order": "C"}',
        '{"array": "<f8"}',
        '{"array": ",8", "shape": [1], "order": "C"}',
        '{"float": "much"}',
        '{"float": 1}',
        '{"path": 3}',
        '{"tuple": 3}',
        "[1]",
        "{}",
        '{"object": "Camera", "fields": {"image_size": "wide"}}',
        '{"list": ' * 30000,
    ],
)
def test_forged_descriptions_are_refused(text: str) -> None:
    inner = struct.pack("<Q", len(text)) + text.encode()
    with pytest.raises(RdstitchError):
        unpack(packing._MAGIC + hashlib.sha256(inner).digest() + inner, [_Whole, Camera])
