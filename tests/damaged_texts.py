"""Damaged versions of good files, for fuzzing what reads them."""

import json
from typing import Any

from hypothesis import strategies as st

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([0, -1, 1e-320, 1e308, -1e308, 10**400, float("nan"), float("inf"), 2**63])
    | st.floats()
    | st.text(max_size=8)
)
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner))


@st.composite
def damaged(draw: st.DrawFn, good: Any) -> Any:
    """A JSON value with one to three of its parts replaced, taken away or doubled."""
    value = json.loads(json.dumps(good))
    for _ in range(draw(st.integers(1, 3))):
        holders: list[tuple[Any, Any]] = list(_holders(value))
        if not holders:
            return draw(VALUES)
        holder, key = draw(st.sampled_from(holders))
        action = draw(st.sampled_from(["replace", "replace", "remove", "double"]))
        if action == "replace":
            holder[key] = draw(VALUES)
        elif action == "remove":
            del holder[key]
        elif isinstance(holder, list):
            holder.append(holder[key])
    return value


@st.composite
def damaged_text(draw: st.DrawFn, good: str) -> bytes:
    """A text with one to four stretches of it cut out, repeated or overwritten."""
    data = good.encode()
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        stop = min(len(data), start + draw(st.integers(0, 40)))
        new = draw(
            st.binary(max_size=6) | st.sampled_from([b"", data[start:stop] * 2, b"1e999", b"nan", b"-", b"[", b"0"])
        )
        data = data[:start] + new + data[stop:]
    return data


def _holders(value: Any) -> Any:
    """Every (container, key) of a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in list(items):
        yield value, key
        yield from _holders(item)
