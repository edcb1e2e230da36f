"""Images that URLs name."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rdstitch.errors import InputError, OutputError
from rdstitch.file_access import is_url, url_of
from rdstitch.inputs.find import find_images
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io.metadata import read_metadata
from rdstitch.io.read import read_image
from rdstitch.io.write import write_image
from rdstitch.outputs import check_output

fsspec = pytest.importorskip("fsspec")


@pytest.fixture
def flight(tmp_path: Path) -> str:
    """The URL of a folder of three images, a list of them, and an empty file, in memory."""
    system = fsspec.filesystem("memory")
    system.rm("/", recursive=True)
    for name in ("f10.png", "f9.jpg", "f2.tif"):
        samples = np.random.default_rng(len(name)).integers(0, 255, (40, 60, 3), dtype=np.uint8)
        write_image(tmp_path / name, samples)
        system.pipe(f"/flight/{name}", (tmp_path / name).read_bytes())
    system.pipe("/flight/notes.txt", b"no image")
    system.pipe("/other/empty.jpg", b"")
    return "memory://flight"


def _source(url: str) -> Source:
    (source,), _ = read_sources([url], camera=None, focal=None, distortion=None, skip_bad=False)
    return source


@pytest.mark.parametrize(
    "url", ["s3://bucket/a/b.jpg", "https://host.org/b.jpg", "file:///tmp/b.jpg", "simplecache::s3://bucket/b.jpg"]
)
def test_a_url_survives_as_a_path(url: str) -> None:
    assert is_url(url)
    assert is_url(Path(url))
    assert url_of(Path(url)) == url


@pytest.mark.parametrize("name", ["frame.jpg", "/tmp/a:/b.jpg", "C:/flight/a.jpg", "a::b/c.jpg"])
def test_names_of_this_machine_are_no_urls(name: str) -> None:
    assert not is_url(name)


def test_folder_and_pattern(flight: str) -> None:
    for named in (flight, f"{flight}/*"):
        assert [frame.path.name for frame in find_images([named]).frames] == ["f2.tif", "f9.jpg", "f10.png"]
    assert [frame.path.name for frame in find_images([f"{flight}/f?.*"]).frames] == ["f2.tif", "f9.jpg"]


@pytest.mark.parametrize("name", ["f10.png", "f9.jpg", "f2.tif"])
def test_the_same_image_as_from_disk(flight: str, tmp_path: Path, name: str) -> None:
    here, there = tmp_path / name, Path(f"{flight}/{name}")
    assert read_metadata(there) == read_metadata(here)
    assert np.array_equal(read_image(there).pixels, read_image(here).pixels)
    assert np.array_equal(read_image(there, 4).pixels, read_image(here, 4).pixels)


def test_an_image_is_fetched_once_each_time_it_is_read(flight: str, monkeypatch: pytest.MonkeyPatch) -> None:
    source = _source(f"{flight}/f9.jpg")
    opened: list[str] = []
    system = type(fsspec.filesystem("memory"))
    original = system.open

    def counted(self: Any, name: str, *arguments: Any, **options: Any) -> Any:
        opened.append(name)
        return original(self, name, *arguments, **options)

    monkeypatch.setattr(system, "open", counted)
    source.read()
    assert len(opened) == 1


def test_content_that_changes_during_the_run_is_noticed(flight: str) -> None:
    source = _source(f"{flight}/f9.jpg")
    source.read()
    system = fsspec.filesystem("memory")
    system.pipe("/flight/f9.jpg", system.cat("/flight/f9.jpg") + b"\0")
    with pytest.raises(InputError, match="has changed during the run"):
        source.read()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("memory://flight/missing.jpg", "no such file; check the address"),
        ("memory://other/empty.jpg", r"is empty \(0 bytes\)"),
        ("memory://flight/a.dng", "raw files are read from this machine's disks only"),
        ("nosuch://flight/a.jpg", "Protocol not known: nosuch"),
    ],
)
def test_what_cannot_be_read_says_why(flight: str, name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_metadata(Path(name))


@pytest.mark.parametrize(
    ("name", "message"),
    [("memory://nothing", "no images at this address"), ("memory://flight/a.mp4", "download the video first")],
)
def test_addresses_of_nothing(flight: str, name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_images([name])


def test_a_message_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(InputError, match=r"URLs need the extra remote: pip install 'rdstitch\[remote\]'"):
        read_metadata(Path("s3://bucket/a.jpg"))


@pytest.mark.parametrize("scheme", ["file://", "local://", "simplecache::file://"])
def test_what_is_read_by_a_url_of_this_machine_is_never_replaced(tmp_path: Path, scheme: str) -> None:
    image = tmp_path / "an image.png"
    image.write_bytes(b"the user's")
    for url in (f"{scheme}{image}", Path(f"{scheme}{image}")):
        with pytest.raises(OutputError, match="is read as input"):
            check_output(image, True, [url])
    check_output(image, True, ["memory://an image.png", "s3://bucket/a.png", "other.png"])
