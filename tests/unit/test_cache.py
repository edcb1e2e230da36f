"""The cache: an entry is used only by the code that made it."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from rdstitch import cache
from rdstitch.cache import Cache


@pytest.fixture(autouse=True)
def _forget_software() -> Iterator[None]:
    """The digest of the sources is computed once a process."""
    cache.software.cache_clear()
    yield
    cache.software.cache_clear()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "package"
    (folder / "robust").mkdir(parents=True)
    (folder / "robust" / "ransac.py").write_text("LIMIT = 1\n", encoding="utf-8")
    monkeypatch.setattr(cache, "_PACKAGE", folder)
    return folder


def _recall(folder: Path, value: int) -> int:
    cache.software.cache_clear()
    return Cache(folder).recall("stage", ("input",), lambda: value)


def test_a_change_of_the_sources_makes_entries_void(tmp_path: Path, package: Path) -> None:
    assert _recall(tmp_path / "cache", 1) == 1
    assert _recall(tmp_path / "cache", 2) == 1
    (package / "robust" / "ransac.py").write_text("LIMIT = 2\n", encoding="utf-8")
    assert _recall(tmp_path / "cache", 2) == 2
    (package / "robust" / "ransac.py").rename(package / "ransac.py")
    assert _recall(tmp_path / "cache", 3) == 3


@pytest.mark.parametrize("changed", ["numpy", "scipy", "opencv-contrib-python-headless", "pillow"])
def test_a_new_version_of_a_package_makes_entries_void(
    tmp_path: Path, package: Path, changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda name: "1.0")
    assert _recall(tmp_path / "cache", 1) == 1
    monkeypatch.setattr("importlib.metadata.version", lambda name: "2.0" if name == changed else "1.0")
    assert _recall(tmp_path / "cache", 2) == 2


def test_of_several_results_only_those_that_are_missing_are_computed(tmp_path: Path) -> None:
    asked: list[list[int]] = []

    def recalled(cache: Cache, names: str) -> list[str]:
        def compute(places: list[int]) -> list[str]:
            asked.append(places)
            return [names[place].upper() for place in places]

        return cache.recall_many("stage", [(name,) for name in names], compute)

    assert recalled(Cache(tmp_path), "ac") == ["A", "C"]
    assert recalled(Cache(tmp_path), "abcd") == ["A", "B", "C", "D"]
    assert recalled(Cache(tmp_path), "abcd") == ["A", "B", "C", "D"]
    assert recalled(Cache(), "ab") == ["A", "B"]
    assert asked == [[0, 1], [1, 3], [0, 1]]


@pytest.mark.parametrize(("folder", "entry"), [(0o700, 0o600), (0o755, 0o644), (0o2775, 0o664)])
def test_entries_can_be_read_by_whoever_may_read_the_folder(tmp_path: Path, folder: int, entry: int) -> None:
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache").chmod(folder)
    assert _recall(tmp_path / "cache", 1) == 1
    (file,) = (path for path in (tmp_path / "cache").rglob("*") if path.is_file())
    assert file.stat().st_mode & 0o7777 == entry
    assert {path.stat().st_mode & 0o7777 for path in file.parents[:2]} == {folder}


def test_an_entry_that_is_a_pipe_is_computed_again(tmp_path: Path, package: Path) -> None:
    assert _recall(tmp_path / "cache", 1) == 1
    (file,) = (path for path in (tmp_path / "cache").rglob("*") if path.is_file())
    file.unlink()
    os.mkfifo(file)
    assert _recall(tmp_path / "cache", 2) == 2


@pytest.mark.skipif(sys.platform == "win32", reason="nothing proves a process dead there")
def test_abandoned_unfinished_files_are_removed(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    cache.recall("stage", (1,), lambda: 1)
    (entry,) = (file for file in tmp_path.rglob("*") if file.is_file())
    abandoned, fresh = (entry.with_name(f".{name}.part") for name in ("abandoned", "fresh"))
    for file in (abandoned, fresh):
        file.write_bytes(b"half")
    os.utime(abandoned, (0, 0))
    entry.unlink()
    cache.recall("stage", (1,), lambda: 1)
    assert (entry.exists(), abandoned.exists(), fresh.exists()) == (True, False, True)


@pytest.mark.skipif(sys.platform == "win32", reason="nothing proves a process dead there")
def test_the_store_of_a_killed_run_is_removed_by_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    script = "import os; from rdstitch.cache import Cache; c = Cache.for_this_run(); os.kill(os.getpid(), 9)"
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", script], env=environment, check=False)
    (left,) = tmp_path.iterdir()
    kept = Cache.for_this_run()
    assert not left.exists()
    assert kept.folder.exists()


def test_the_cache_of_one_run_reads_no_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "software", lambda: pytest.fail("read"))
    kept = Cache.for_this_run()
    assert kept.recall("stage", ("input",), lambda: 1) == 1
    assert kept.recall("stage", ("input",), lambda: 2) == 1
