"""The cache, and what is stored in it."""

import gc
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import rdstitch
from rdstitch.errors import ArgumentError, InputError
from rdstitch.geometry.camera import Camera
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.system import cache
from rdstitch.system.cache import Cache, InMemory, OnDisk
from rdstitch.system.packing import digest, pack, unpack
from rdstitch.system.temporary_folder import TemporaryFolder


@pytest.fixture(autouse=True)
def _forget_software() -> Iterator[None]:
    """The digest of the sources is computed once a process."""
    cache.software.cache_clear()
    yield
    cache.software.cache_clear()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    assert Path(rdstitch.__file__).parent == cache._PACKAGE
    folder = tmp_path / "package"
    (folder / "robust").mkdir(parents=True)
    (folder / "robust" / "ransac.py").write_text("LIMIT = 1\n", encoding="utf-8")
    monkeypatch.setattr(cache, "_PACKAGE", folder)
    return folder


def _recall(folder: Path, value: int) -> int:
    cache.software.cache_clear()
    return Cache.at(folder).recall("stage", ("input",), lambda: value)


def test_a_change_of_the_sources_makes_entries_void(tmp_path: Path, package: Path) -> None:
    assert _recall(tmp_path / "cache", 1) == 1
    assert _recall(tmp_path / "cache", 2) == 1
    (package / "robust" / "ransac.py").write_text("LIMIT = 2\n", encoding="utf-8")
    assert _recall(tmp_path / "cache", 2) == 2
    (package / "robust" / "ransac.py").rename(package / "ransac.py")
    assert _recall(tmp_path / "cache", 3) == 3


@pytest.mark.parametrize("changed", ["numpy", "scipy", "opencv-contrib-python-headless", "pillow"])
def test_another_package_voids(tmp_path: Path, package: Path, changed: str, monkeypatch: pytest.MonkeyPatch) -> None:
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

    assert recalled(Cache.at(tmp_path), "ac") == ["A", "C"]
    assert recalled(Cache.at(tmp_path), "abcd") == ["A", "B", "C", "D"]
    assert recalled(Cache.at(tmp_path), "abcd") == ["A", "B", "C", "D"]
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
    cache = Cache.at(tmp_path)
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
    script = "import os; from rdstitch.system.cache import Cache; c = Cache.for_this_run(); os.kill(os.getpid(), 9)"
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


@pytest.fixture(autouse=True)
def _nothing_recent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "_recent", cache._RecentlyUsed(0))


def _kept(folder: Path, name: str, value: float) -> OnDisk[tuple[float]]:
    kept = Cache.at(folder).stored("stage", (name,), lambda: (value,))
    assert isinstance(kept, OnDisk)
    return kept


def test_what_was_kept_is_read_again(tmp_path: Path) -> None:
    assert _kept(tmp_path, "a", 1.0).load() == (1.0,)
    # An entry is not computed twice.
    assert _kept(tmp_path, "a", 2.0).load() == (1.0,)
    assert Cache().stored("stage", ("a",), lambda: (3.0,)).load() == (3.0,)


@pytest.mark.parametrize("damage", ["removed", "cut", "replaced"])
def test_an_entry_that_is_gone_is_named(tmp_path: Path, damage: str) -> None:
    found, other = _kept(tmp_path, "a", 1.0), _kept(tmp_path, "b", 2.0)
    if damage == "removed":
        found.file.unlink()
    else:
        found.file.write_bytes(found.file.read_bytes()[:-1] if damage == "cut" else other.file.read_bytes())
    with pytest.raises(InputError, match="run again") as error:
        found.load()
    assert str(found.file) in str(error.value)


def test_an_entry_that_was_removed_is_no_longer_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "_recent", cache._RecentlyUsed(20_000))
    found = _kept(tmp_path, "a", 1.0)
    assert found.load() is found.load()
    found.remove()
    with pytest.raises(InputError, match="run again"):
        found.load()
    found.remove()


def test_what_was_used_recently_stays_in_memory_within_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [Cache.at(tmp_path).stored("stage", (k,), lambda k=k: np.full(1000, k)) for k in range(4)]  # type: ignore[misc]
    monkeypatch.setattr(cache, "_recent", cache._RecentlyUsed(20_000))
    loaded = [entry.load() for entry in entries[:2]]
    assert all(entry.load() is value for entry, value in zip(entries[:2], loaded, strict=True))
    entries[0].load()
    entries[2].load()
    # Room for two: the second one was used least recently.
    assert entries[0].load() is loaded[0]
    assert entries[1].load() is not loaded[1]


def test_a_folder_of_a_run_lives_as_long_as_what_lies_in_it() -> None:
    store = Cache.for_this_run()
    found = store.stored("stage", ("a",), lambda: 5)
    folder = store.folder
    del store
    gc.collect()
    # As it comes back from a worker.
    found = pickle.loads(pickle.dumps(found))
    gc.collect()
    assert found.load() == 5
    del found
    gc.collect()
    assert not folder.exists()


def test_other_processes_do_not_remove_the_folder() -> None:
    own = TemporaryFolder()
    program = "import pickle, sys; print(pickle.loads(sys.stdin.buffer.read()).path)"
    done = subprocess.run([sys.executable, "-c", program], input=pickle.dumps(own), capture_output=True, check=True)
    assert done.stdout.decode().strip() == str(own.path)
    assert own.path.is_dir()


def test_without_a_place_for_temporary_files_everything_stays_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> str:
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr("tempfile.gettempdir", nowhere)
    found = Cache.for_this_run().stored("stage", ("a",), lambda: 5)
    assert isinstance(found, InMemory)
    assert found.load() == 5


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


def test_what_has_no_digest_is_refused_and_values_of_other_types_or_limits_have_other_ones() -> None:
    for value in (object(), {1: 2}, np.array(["text"]), {3}, b"bytes"):
        with pytest.raises(ArgumentError):
            digest(value)
    values: list[Any] = [0, 0.0, False, "", "0", [], (), {}, ["a", "b"], ["ab"], [["a"], "b"], ["a", ["b"]], None]
    values += [np.zeros(2), np.zeros((2, 1)), np.zeros(2, np.float32), np.zeros((2, 2)), np.asfortranarray(np.eye(2))]
    values += ["None", np.eye(2), Path("a"), "a", Camera((4, 3)), Camera((3, 4)), (Camera((4, 3)),)]
    assert len({digest(value) for value in values}) == len(values)
    # Dictionaries are equal in any order.
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


class _MakesAFolder:
    """Would build a cache in a folder when it is read."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __reduce__(self) -> tuple[type[Cache], tuple[Path]]:
        return Cache, (self._folder,)


def test_what_is_read_makes_no_folder(tmp_path: Path) -> None:
    assert unpack(pack(_MakesAFolder(tmp_path / "made"))) == Cache(tmp_path / "made")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("value", [_Runs(), open, Camera.distort, StitchOptions, np.load, [print], Cache])
def test_what_could_run_code_is_refused(value: Any) -> None:
    """A class alone is data; what builds it is a dataclass of this package."""
    packed = pack(value)
    if value in (StitchOptions, Cache):
        assert unpack(packed) is value
    else:
        with pytest.raises(InputError, match="no result"):
            unpack(packed)


def test_an_entry_that_nobody_would_read_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rdstitch.system.cache._MAX_ENTRY", 1000)
    stored = Cache.at(tmp_path).stored("stage", (1,), lambda: np.zeros(1000))
    assert isinstance(stored, InMemory)
    assert len(stored.load()) == 1000
