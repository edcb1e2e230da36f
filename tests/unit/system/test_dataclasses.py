"""Dataclasses that have their methods in common behave as the standard library's."""

import dataclasses
import pickle
from typing import Any

import pytest

from rdstitch.system.dataclasses import dataclass, field, replace


def _classes(dataclass: Any) -> tuple[type, type]:
    @dataclass(frozen=True)
    class Base:
        a: int
        b: list[int] = field(default_factory=list, compare=False)
        c: int = field(default=3, repr=False)

    @dataclass(frozen=True)
    class Derived(Base):
        d: str = "d"
        e: int = field(init=False)

        def __post_init__(self) -> None:
            object.__setattr__(self, "e", self.a + self.c)

    Derived.__qualname__ = "Derived"
    return Base, Derived


@pytest.mark.parametrize("arguments", [((1,), {}), ((1, [2]), {"d": "x", "c": 4}), ((), {"d": "y", "a": 2})])
def test_instances_are_those_of_the_standard_library(arguments: tuple[tuple[Any, ...], dict[str, Any]]) -> None:
    given, named = arguments
    (_, ours), (_, standard) = _classes(dataclass), _classes(dataclasses.dataclass)
    one, other = ours(*given, **named), standard(*given, **named)
    assert repr(one) == repr(other)
    assert dataclasses.asdict(one) == dataclasses.asdict(other)
    assert hash(one) == hash(other)
    assert one == replace(one, b=[7]) != replace(one, a=9)
    assert replace(one, a=9).e == 9 + one.c
    assert one.b is not ours(*given, **named).b or given[1:]
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.a = 5


@pytest.mark.parametrize(
    "arguments", [((), {}), ((1, [], 3, "x", 4), {}), ((1,), {"a": 1}), ((1,), {"z": 1}), ((1,), {"e": 1})]
)
def test_arguments_that_do_not_fit_are_refused(arguments: tuple[tuple[Any, ...], dict[str, Any]]) -> None:
    for kind in (dataclass, dataclasses.dataclass):
        with pytest.raises(TypeError):
            _classes(kind)[1](*arguments[0], **arguments[1])


def test_they_are_pickled() -> None:
    assert pickle.loads(pickle.dumps(_Pickled(1))) == _Pickled(1)


@dataclass(frozen=True)
class _Pickled:
    a: int
