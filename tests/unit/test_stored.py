"""Results on disk: read when needed, never believed when damaged, and a run's own folder is removed after it."""

import gc
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rdstitch import cache
from rdstitch.cache import Cache, Stored
from rdstitch.errors import InputError
from rdstitch.outputs import TemporaryFolder


@pytest.fixture(autouse=True)
def _nothing_recent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "_recent", cache._RecentlyUsed(0))


def _kept(folder: Path, name: str, value: float) -> Stored[tuple[float]]:
    return Cache(folder).stored("stage", (name,), lambda: (value,))


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


def test_what_was_used_recently_stays_in_memory_within_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [Cache(tmp_path).stored("stage", (k,), lambda k=k: np.full(1000, k)) for k in range(4)]  # type: ignore[misc]
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
    assert found.file is None
    assert found.load() == 5
