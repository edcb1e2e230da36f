"""Frozen dataclasses are what the standard library's are, and made without its generated methods."""

import dataclasses
import pickle
from typing import Any

import pytest

from rdstitch.frozen import dataclass


@dataclass(frozen=True)
class _Shared:
    """One of ours."""

    name: str
    size: tuple[int, int] = (1, 2)
    note: Any = dataclasses.field(default=None, compare=False, repr=False)


@dataclasses.dataclass(frozen=True)
class _Generated:
    """The same of the standard library."""

    name: str
    size: tuple[int, int] = (1, 2)
    note: Any = dataclasses.field(default=None, compare=False, repr=False)


@dataclass(frozen=True, eq=False, repr=False)
class _Plain:
    """Compared by identity, and shows itself."""

    name: str

    def __repr__(self) -> str:
        return f"<{self.name}>"


@dataclass(frozen=True)
class _Grown(_Shared):
    """A subclass."""

    count: int = 3


def test_they_show_compare_and_hash_as_generated_ones_do() -> None:
    ours = _Shared("a", note=[1])
    theirs: Any = _Generated("a", note=[1])
    assert repr(ours).partition("(")[2] == repr(theirs).partition("(")[2]
    assert ours == _Shared("a", note=[2])
    assert ours != _Shared("b")
    assert ours != theirs
    assert hash(ours) == hash(_Shared("a")) == hash(theirs)
    assert _Grown("a") != ours
    assert (_Grown("a").count, _Grown("a", count=4).count) == (3, 4)


def test_they_cannot_be_changed_but_replaced_and_pickled() -> None:
    ours = _Shared("a")
    with pytest.raises(dataclasses.FrozenInstanceError):
        ours.name = "b"  # type: ignore[misc]
    with pytest.raises(dataclasses.FrozenInstanceError):
        ours.other = "b"  # type: ignore[attr-defined]
    with pytest.raises(dataclasses.FrozenInstanceError):
        del ours.name
    assert dataclasses.replace(ours, name="b") == _Shared("b")
    assert pickle.loads(pickle.dumps(ours)) == ours


def test_identity_and_own_methods_stay() -> None:
    assert _Plain("a") != _Plain("a")
    assert repr(_Plain("a")) == "<a>"
    assert len({_Plain("a"), _Plain("a")}) == 2
