"""Values as bytes and back."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rdstitch.cache import Cache, digest, pack, unpack
from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError, InputError
from rdstitch.options import StitchOptions

_ARRAYS = hnp.arrays(
    st.sampled_from([np.dtype(kind) for kind in ("f8", "f4", "u1", "u2", "i8", "bool")]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)
_PLAIN = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(st.characters(codec=None)), _ARRAYS)
_VALUES = st.recursive(
    _PLAIN,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.tuples(inner, inner), st.dictionaries(st.text(max_size=3), inner, max_size=3)
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


def test_dataclasses_come_back() -> None:
    value = (Camera((400, 300), -0.2, focal=350.0), Path("a/b"), np.arange(6.0).reshape(2, 3).T)
    camera, path, turned = unpack(pack(value))
    assert (camera, path) == value[:2]
    # The order in memory decides on the last bits of sums.
    assert turned.flags.f_contiguous
    assert turned.flags.writeable


def test_what_has_no_digest_is_refused() -> None:
    for value in (object(), {1: 2}, np.array(["text"]), {3}, b"bytes"):
        with pytest.raises(ArgumentError):
            digest(value)


def test_values_of_other_types_or_limits_have_other_digests() -> None:
    values: list[Any] = [0, 0.0, False, "", "0", [], (), {}, ["a", "b"], ["ab"], [["a"], "b"], ["a", ["b"]], None]
    values += [np.zeros(2), np.zeros((2, 1)), np.zeros(2, np.float32), np.zeros((2, 2)), np.asfortranarray(np.eye(2))]
    values += ["None", np.eye(2), Path("a"), "a", Camera((4, 3)), Camera((3, 4)), (Camera((4, 3)),)]
    assert len({digest(value) for value in values}) == len(values)


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
            unpack(bad)


class _Runs:
    """Would run code when it is read."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, ("true",)


@pytest.mark.parametrize("value", [_Runs(), open, Camera.distort, StitchOptions, np.load, [print], Cache])
def test_what_could_run_code_is_refused(value: Any) -> None:
    """A class alone is data; what builds it is a dataclass of this package."""
    packed = pack(value)
    if value in (StitchOptions, Cache):
        assert unpack(packed) is value
    else:
        with pytest.raises(InputError, match="no result"):
            unpack(packed)
