"""Files that change during a run, images that a decoder doubts, and those that need too much memory."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rdstitch.errors import InputError, LimitError
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.source import Source, read_sources


def _save(path: Path, seed: int) -> None:
    Image.fromarray(np.random.default_rng(seed).integers(0, 256, (120, 160), dtype=np.uint8)).save(path)


def _source(path: Path, guard: InputGuard | None = None, max_memory: int | None = None) -> Source:
    options = {"camera": None, "focal": None, "distortion": None, "skip_bad": False}
    sources, _ = read_sources([path], guard=guard, max_memory=max_memory, **options)  # type: ignore[arg-type]
    return sources[0]


@pytest.mark.parametrize("how", ["another file", "in place"])
def test_another_image_of_the_same_size_is_noticed(tmp_path: Path, how: str) -> None:
    path, other = tmp_path / "a.bmp", tmp_path / "b.bmp"
    _save(path, 1)
    _save(other, 2)
    os.utime(path, ns=(0, 0))
    source, before = _source(path), path.stat()
    source.read()
    source.read()
    assert other.stat().st_size == before.st_size
    if how == "another file":
        other.replace(path)
    else:
        path.write_bytes(other.read_bytes())
    with pytest.raises(InputError, match=r"a\.bmp: has changed during the run"):
        source.read()


def test_what_another_process_read_must_have_been_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.bmp"
    _save(path, 1)
    here, same, later = InputGuard(), InputGuard(), InputGuard()
    for guard in (here, same):
        with guard.reading(path):
            pass
    here.learn(same.notes_on([path]))
    os.utime(path, ns=(0, 0))
    with later.reading(path):
        pass
    with pytest.raises(InputError, match=r"a\.bmp: has changed during the run"):
        here.learn(later.notes_on([path]))


def test_a_file_that_is_being_written_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.bmp"
    _save(path, 1)
    guard = InputGuard()
    with pytest.raises(InputError, match="is being written to"), guard.reading(path):
        path.write_bytes(path.read_bytes() + b"more")


@pytest.mark.parametrize("strict", [False, True])
def test_damage_is_named_or_refused(tmp_path: Path, strict: bool) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (120, 160, 3), dtype=np.uint8)).save(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + data[len(data) // 2 + 900 :])
    guard = InputGuard(strict)
    source = _source(path, guard)
    if strict:
        with pytest.raises(InputError, match=r"a\.jpg: is damaged"):
            source.read()
        return
    source.read()
    (message,) = guard.messages
    assert message.images == (str(path),)
    assert message.images == (str(path),)


def test_an_image_that_needs_too_much_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.new("RGB", (1000, 500)).save(path)
    _source(path, max_memory=3_000_000)
    with pytest.raises(LimitError, match=r"a\.png: 1000 x 500 pixels need 3 MB .* --max-memory allows 3 MB"):
        _source(path, max_memory=2_999_999)
