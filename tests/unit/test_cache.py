"""The cache: an entry is used only by the code that made it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from rdstitch import cache
from rdstitch.cache import Cache


@pytest.fixture(autouse=True)
def _forget_software() -> Iterator[None]:
    """The digest of the sources is computed once a process."""
    cache._software.cache_clear()
    yield
    cache._software.cache_clear()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package in the place of this one."""
    folder = tmp_path / "package"
    (folder / "robust").mkdir(parents=True)
    (folder / "robust" / "ransac.py").write_text("LIMIT = 1\n", encoding="utf-8")
    monkeypatch.setattr(cache, "files", lambda name: folder)
    return folder


def _recall(folder: Path, value: int) -> int:
    cache._software.cache_clear()
    return Cache(folder).recall("stage", (), ("input",), lambda: value)


def test_a_change_of_the_sources_makes_entries_void(tmp_path: Path, package: Path) -> None:
    assert _recall(tmp_path / "cache", 1) == 1
    assert _recall(tmp_path / "cache", 2) == 1
    (package / "robust" / "ransac.py").write_text("LIMIT = 2\n", encoding="utf-8")
    assert _recall(tmp_path / "cache", 2) == 2
    (package / "robust" / "ransac.py").rename(package / "ransac.py")
    assert _recall(tmp_path / "cache", 3) == 3


def test_what_is_no_source_makes_none_void(tmp_path: Path, package: Path) -> None:
    assert _recall(tmp_path / "cache", 1) == 1
    (package / "robust" / "__pycache__").mkdir()
    (package / "robust" / "__pycache__" / "ransac.pyc").write_bytes(b"compiled")
    (package / "robust" / "py.typed").touch()
    assert _recall(tmp_path / "cache", 2) == 1


@pytest.mark.parametrize("changed", ["numpy", "scipy", "opencv-contrib-python-headless", "pillow"])
def test_a_new_version_of_a_package_makes_entries_void(
    tmp_path: Path, package: Path, changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "version", lambda name: "1.0")
    assert _recall(tmp_path / "cache", 1) == 1
    monkeypatch.setattr(cache, "version", lambda name: "2.0" if name == changed else "1.0")
    assert _recall(tmp_path / "cache", 2) == 2


def test_of_several_results_only_those_that_are_missing_are_computed(tmp_path: Path) -> None:
    asked: list[list[int]] = []

    def recalled(cache: Cache, names: str) -> list[str]:
        def compute(places: list[int]) -> list[str]:
            asked.append(places)
            return [names[place].upper() for place in places]

        return cache.recall_many("stage", (), [(name,) for name in names], compute)

    assert recalled(Cache(tmp_path), "ac") == ["A", "C"]
    assert recalled(Cache(tmp_path), "abcd") == ["A", "B", "C", "D"]
    assert recalled(Cache(tmp_path), "abcd") == ["A", "B", "C", "D"]
    assert recalled(Cache(), "ab") == ["A", "B"]
    assert asked == [[0, 1], [1, 3], [0, 1]]
