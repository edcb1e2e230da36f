"""Fixtures that tests share."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples in every run; the slow tests search at random.
settings.register_profile("fixed", derandomize=True)
settings.register_profile("search", max_examples=300, deadline=None)
# For an evening: pytest --hypothesis-profile long tests/property
settings.register_profile("long", max_examples=20_000, deadline=None)
settings.load_profile("fixed")

# The development images lie beside the checkout; they are not part of the project.
_SHARED_DATA = Path(__file__).resolve().parents[1] / "../shared/data"


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """``shared_data(name)``: path of development images; the test is skipped where they are absent."""

    def locate(name: str) -> Path:
        path = (_SHARED_DATA / name).resolve()
        if not path.exists():
            pytest.skip(f"development images {name!r} are not here")
        return path

    return locate
