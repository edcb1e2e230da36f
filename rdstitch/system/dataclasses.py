"""Dataclasses that have their methods in common: compiled for each of 200 classes, they take a tenth of a small run.

For what the package uses itself; public classes are the standard library's, whose ``__init__`` has a signature.
"""

from dataclasses import MISSING, FrozenInstanceError, field, fields, replace
from dataclasses import dataclass as standard
from typing import TYPE_CHECKING, Any

__all__ = ["dataclass", "field", "fields", "replace"]

if TYPE_CHECKING:
    from dataclasses import dataclass
else:

    def dataclass(cls=None, /, *, frozen=False, eq=True, repr=True):  # noqa: A002
        """The standard library's; a derived one must be of the same kind."""
        if cls is None:
            return lambda cls: dataclass(cls, frozen=frozen, eq=eq, repr=repr)
        methods = {"__init__": _init}
        if repr:
            methods["__repr__"] = _repr
        if eq:
            methods |= {"__eq__": _eq, "__hash__": _hash if frozen else None}
        if frozen:
            methods |= {"__setattr__": _refuse, "__delattr__": _refuse}
        for name in methods.keys() - vars(cls).keys():
            setattr(cls, name, methods[name])
        made = standard(cls, init=False, repr=False, eq=False)
        made.__init_fields__ = {each.name: each for each in fields(made) if each.init}
        return made


def _init(self: Any, /, *given: Any, **named: Any) -> None:
    expected: dict[str, Any] = self.__init_fields__
    values = dict(zip(expected, given, strict=False)) | named
    if len(values) < len(given) + len(named) or not values.keys() <= expected.keys():
        raise TypeError(f"{type(self).__name__} takes {', '.join(expected)}, each once")
    if len(values) < len(expected):
        for name in expected.keys() - values.keys():
            default, make = expected[name].default, expected[name].default_factory
            if default is make is MISSING:
                raise TypeError(f"{type(self).__name__} needs {name}")
            values[name] = default if make is MISSING else make()
    vars(self).update(values)
    if hasattr(self, "__post_init__"):
        self.__post_init__()


def _repr(self: Any) -> str:
    shown = [f"{each.name}={getattr(self, each.name)!r}" for each in fields(self) if each.repr]
    return f"{type(self).__qualname__}({', '.join(shown)})"


def _compared(self: Any) -> tuple[Any, ...]:
    return tuple(getattr(self, each.name) for each in fields(self) if each.compare)


def _eq(self: Any, other: object) -> bool:
    return _compared(self) == _compared(other) if type(other) is type(self) else NotImplemented


def _hash(self: Any) -> int:
    return hash(_compared(self))


def _refuse(self: Any, name: str, *_: Any) -> None:
    raise FrozenInstanceError(f"{type(self).__name__}.{name} is not changed")
