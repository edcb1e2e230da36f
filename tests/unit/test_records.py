"""Records: what holds of every dataclass of the package."""

import pkgutil
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module

import rdstitch


def _records() -> Iterator[type]:
    for module in pkgutil.walk_packages(rdstitch.__path__, "rdstitch."):
        for value in vars(import_module(module.name)).values():
            if isinstance(value, type) and is_dataclass(value) and value.__module__ == module.name:
                yield value


def test_records_of_arrays_have_no_equality_that_arrays_do_not_have() -> None:
    """NumPy compares element by element: ``==`` of such records raises, or decides by the order of their fields."""
    arrays = ("ndarray", "NDArray", "ArrayLike", "Array[")
    compared = [
        f"{kind.__module__}.{kind.__name__}"
        for kind in _records()
        if "__eq__" in vars(kind)
        and any(field.compare and any(word in str(field.type) for word in arrays) for field in fields(kind))
    ]
    assert not compared, f"@dataclass(eq=False): {compared}"
