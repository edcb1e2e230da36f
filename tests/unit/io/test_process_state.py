"""A host program that reads images in threads finds its warnings, handlers and log levels as they were."""

import logging
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from rdstitch.errors import InputError
from rdstitch.io import read_image, read_metadata, write_image


def _state() -> tuple[object, ...]:
    handlers = [list(logging.getLogger(name).handlers) for name in (None, "PIL", "tifffile")]
    return list(warnings.filters), warnings.showwarning, handlers, cv2.utils.logging.getLogLevel(), cv2.getNumThreads()


def test_reading_in_threads_leaves_the_process_as_it_was(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for number in range(10):
        deep = rng.integers(0, 65536, (64, 64, 3), dtype=np.uint16)
        write_image(tmp_path / f"{number}.png", deep)
        Image.fromarray((deep // 257).astype(np.uint8)).save(tmp_path / f"{number}.jpg")
        (tmp_path / f"{number}.webp").write_bytes(b"RIFF\x10\0\0\0WEBP" + rng.bytes(40))

    def read(path: Path) -> None:
        if path.suffix == ".webp":
            with pytest.raises(InputError):
                read_metadata(path)
        else:
            read_image(path)

    before = _state()
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(read, sorted(tmp_path.iterdir()) * 10))
    assert _state() == before


def test_what_a_decoder_warns_of_reaches_the_host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def bit_depth(image: Image.Image) -> int:
        warnings.warn("an odd file", UserWarning, stacklevel=1)
        return 8

    Image.new("L", (8, 8)).save(tmp_path / "a.png")
    monkeypatch.setattr("rdstitch.io.metadata._bit_depth", bit_depth)
    with pytest.warns(UserWarning, match="an odd file"):
        read_metadata(tmp_path / "a.png")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError, match=r"a\.png: .*an odd file"):
            read_metadata(tmp_path / "a.png")
