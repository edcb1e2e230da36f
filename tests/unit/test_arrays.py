"""Records of arrays with the first axis in common."""

from dataclasses import dataclass

import numpy as np
import pytest

from rdstitch.arrays import FloatArray, Rows


@dataclass(frozen=True, eq=False)
class _Rows(Rows):
    x: FloatArray
    y: FloatArray | None = None


@pytest.mark.parametrize("order", [1, -1])
def test_a_field_is_in_all_parts_or_in_none(order: int) -> None:
    bare, full = _Rows(np.zeros(2)), _Rows(np.ones(3), np.ones(3))
    assert _Rows.concatenate([bare, bare]).y is None
    assert len(_Rows.concatenate([full, full]).y) == 6
    with pytest.raises(ValueError, match="dimension"):
        _Rows.concatenate([bare, full][::order])
