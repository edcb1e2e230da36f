"""Output files, and the safe opening of files."""

import os
import platform
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rdstitch.errors import InputError, OutputError
from rdstitch.inputs.find import find_images
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.source import Source, read_sources
from rdstitch.inputs.times import time_of
from rdstitch.io.metadata import read_metadata
from rdstitch.io.read import read_image
from rdstitch.io.write import write_image
from rdstitch.system.cache import Cache
from rdstitch.system.file_access import content_state, is_url, url_of
from rdstitch.system.output_checks import check_folder, check_outputs
from rdstitch.system.outputs import Outputs, replace_folder, write_bytes_atomic
from rdstitch.system.temporary_folder import TemporaryFolder
from tests.faults import OPERATIONS, Operation, failing_disk

_check = partial(check_folder, overwrite=True)
_NAMES = ("a.dzi", "a.dzw", "a.dzi.json")


def _write_all(folder: Path, content: bytes, overwrite: bool) -> None:
    with Outputs(overwrite) as outputs:
        with (
            outputs.writing_pair(folder / "a_files", folder / "a.dzi", _check) as (tiles, description),
        ):
            (tiles / "0").mkdir()
            for name in ("0_0.jpg", "1_0.jpg"):
                (tiles / "0" / name).write_bytes(content)
            description.write_bytes(content)
        for name in _NAMES[1:]:
            outputs.write(folder / name, content)


def _state(folder: Path) -> dict[str, bytes]:
    """Every file with its content, hidden ones too; empty folders are listed as well."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"folder" for path in folder.rglob("*")
    }


@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("links", [True, False])
def test_after_any_failure_every_file_is_whole(
    tmp_path: Path, operation: Operation, overwrite: bool, links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_links(*arguments: object) -> None:
        raise OSError(1, "Operation not permitted")

    if not links:
        monkeypatch.setattr(os, "link", no_links)
    with failing_disk(operation) as disk:
        _write_all(tmp_path, b"new", overwrite)
    failed = 0
    for failing in range(disk.count):
        folder = tmp_path / str(failing)
        folder.mkdir()
        if overwrite:
            _write_all(folder, b"old", overwrite=True)
        before = _state(folder)
        try:
            with failing_disk(operation, failing):
                _write_all(folder, b"new", overwrite)
        except OutputError as error:
            failed += str(folder / "a") in str(error)
            after = _state(folder)
            # While nothing is in its place yet, all is as it was; then files are replaced one after the other.
            assert after == before or operation == "rename"
            assert not overwrite or set(after) == set(before)
            assert set(after.values()) <= {b"old", b"new", b"folder"}
            assert len({content for name, content in after.items() if name.endswith(".jpg")}) <= 1
            _write_all(folder, b"new", overwrite=True)
        assert set(_state(folder).values()) == {b"new", b"folder"}
    # What can be done without a link is.
    assert disk.count >= failed >= (1 if operation == "rename" and not overwrite else 3)


@pytest.mark.parametrize("appearing", [*_NAMES, "a_files/x"])
def test_a_file_that_appears_during_the_run_is_kept(tmp_path: Path, appearing: str) -> None:
    def write() -> None:
        with Outputs(overwrite=False) as outputs:
            with outputs.writing_folder(tmp_path / "a_files", _check) as tiles:
                (tiles / "0").mkdir()
            for name in _NAMES:
                outputs.write(tmp_path / name, b"ours")
            (tmp_path / appearing).parent.mkdir(exist_ok=True)
            (tmp_path / appearing).write_bytes(b"theirs")

    with pytest.raises(OutputError, match="exists already"):
        write()
    assert set(_state(tmp_path).values()) <= {b"theirs", b"folder"}
    assert (tmp_path / appearing).read_bytes() == b"theirs"


def test_a_file_that_appears_at_the_last_moment_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = os.link

    def late(source: Path, place: Path) -> None:
        place.write_bytes(b"theirs")
        link(source, place)

    monkeypatch.setattr(os, "link", late)
    with pytest.raises(OutputError, match="appeared during the run"):
        write_bytes_atomic(tmp_path / "a.txt", b"ours", overwrite=False)
    assert _state(tmp_path) == {"a.txt": b"theirs"}


@pytest.mark.parametrize("existing", [True, False])
def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path: Path, existing: bool) -> None:
    (tmp_path / "elsewhere").mkdir()
    target, link = tmp_path / "elsewhere" / "target.png", tmp_path / "link.png"
    link.symlink_to(target)
    if not existing:
        with pytest.raises(OutputError, match="link to nothing"):
            check_outputs([link], overwrite=True)
        return
    target.write_bytes(b"old")
    target.chmod(0o640)
    with pytest.raises(OutputError, match="exists"):
        check_outputs([link], overwrite=False)
    check_outputs([link], overwrite=True)
    write_bytes_atomic(link, b"new")
    assert link.is_symlink()
    assert (target.read_bytes(), target.stat().st_mode & 0o777) == (b"new", 0o640)
    assert len(list((tmp_path / "elsewhere").iterdir())) == 1


def test_a_folder_of_the_user_is_no_folder_of_tiles(tmp_path: Path) -> None:
    treasure = tmp_path / "photos_files" / "2023" / "raw" / "wedding.nef"
    treasure.parent.mkdir(parents=True)
    treasure.write_bytes(b"dear")
    with pytest.raises(OutputError, match=r"photos_files: .*holds other files"):
        check_outputs([tmp_path / "photos.dzi"], overwrite=True)

    def write() -> None:
        with Outputs(overwrite=True) as outputs:
            with outputs.writing_folder(tmp_path / "photos_files", _check):
                pass
            outputs.write(tmp_path / "photos.dzi", b"new")

    # Also when it comes there during the run.
    with pytest.raises(OutputError, match="holds other files"):
        write()
    assert _state(tmp_path)["photos_files/2023/raw/wedding.nef"] == b"dear"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos_files"]


@pytest.mark.parametrize("name", ["0/0_0.png", "0/x.jpg", "readme.txt", "x/0_0.jpg", "123/0_0.jpg", "0/1/0_0.jpg"])
def test_whatever_is_no_tile_keeps_a_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "a_files" / "0").mkdir(parents=True)
    (tmp_path / "a_files" / "0" / "0_0.jpg").write_bytes(b"tile")
    with pytest.raises(OutputError, match="a_files: exists already"):
        check_outputs([tmp_path / "a.dzi"], overwrite=False)
    check_outputs([tmp_path / "a.dzi"], overwrite=True)
    (tmp_path / "a_files" / name).parent.mkdir(exist_ok=True)
    (tmp_path / "a_files" / name).write_bytes(b"dear")
    with pytest.raises(OutputError, match="holds other files"):
        check_outputs([tmp_path / "a.dzi"], overwrite=True)


_KILLED = """
import os, signal, sys
from pathlib import Path
from rdstitch.system.outputs import Outputs
from rdstitch.system.outputs import TemporaryFolder
with TemporaryFolder() as folder, Outputs(False) as outputs:
    (folder / "frame.png").write_bytes(b"half")
    with outputs.writing(sys.argv[1]) as staged:
        staged.write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)
"""


def _leftovers(*folders: Path) -> list[Path]:
    return [path for folder in folders for path in folder.iterdir() if "rdstitch-" in path.name]


def test_leftovers_of_the_dead_go_those_of_the_living_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, temporary = tmp_path / "out", tmp_path / "tmp"
    out.mkdir()
    temporary.mkdir()
    environment = {**os.environ, "TMPDIR": str(temporary), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run([sys.executable, "-c", _KILLED, out / "a.txt"], env=environment, check=False)
    assert done.returncode == -signal.SIGKILL
    assert len(_leftovers(out, temporary)) == 2
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    living = TemporaryFolder(out, ".rdstitch-")
    with TemporaryFolder() as frames:
        write_bytes_atomic(out / "a.txt", b"whole")
        assert set(_leftovers(out, temporary)) == {living.path, frames}
    living.close()
    assert _leftovers(out, temporary) == []


def test_what_a_process_of_another_machine_writes_stays(tmp_path: Path) -> None:
    # On a mount that both see, whose locks hold nothing.
    for name, host in (("here", platform.node()), ("there", "another machine")):
        (tmp_path / f".rdstitch-{name}.part").mkdir()
        (tmp_path / f".rdstitch-{name}.part" / "lock").write_text(f"{host}\n{2**30}\n")
    write_bytes_atomic(tmp_path / "a.txt", b"x")
    assert [path.name for path in _leftovers(tmp_path)] == [".rdstitch-there.part"]


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="the system does not say which files are open")
def test_nothing_is_renamed_in_which_a_file_is_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows refuses that."""

    def refusing(rename: Callable[[Path, Path], None]) -> Callable[[Path, Path], None]:
        def renamed(old: Path, new: Path) -> None:
            targets = [os.path.realpath(link) for link in Path("/proc/self/fd").iterdir()]
            if any(Path(target).is_relative_to(old) for target in targets):
                raise PermissionError(13, "is used by another process", str(old))
            rename(old, new)

        return renamed

    for name in ("rename", "replace"):
        monkeypatch.setattr(os, name, refusing(getattr(os, name)))
    for _ in range(2):
        with Outputs(overwrite=True) as outputs:
            with outputs.writing_folder(tmp_path / "x_files", _check) as folder:
                (folder / "0").mkdir()
                (folder / "0" / "0_0.jpg").write_bytes(b"tile")
            outputs.write(tmp_path / "x.dzi", b"description")
    assert {path.name for path in tmp_path.rglob("*")} == {"x_files", "0", "0_0.jpg", "x.dzi"}


@pytest.mark.parametrize("interrupted", [0, 1])
def test_an_interrupt_leaves_the_old_folder_or_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interrupted: int
) -> None:
    place, new = tmp_path / "a", tmp_path / "new"
    for folder in (place, new):
        folder.mkdir()
        (folder / "content").write_text(folder.name)
    rename, done = os.rename, []

    def interrupting(source: Path, target: Path) -> None:
        rename(source, target)
        done.append(target)
        if len(done) == interrupted + 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(os, "rename", interrupting)
    with pytest.raises(KeyboardInterrupt):
        replace_folder(new, place)
    assert (place / "content").read_text() == ("a", "new")[interrupted]


def test_what_a_caught_error_cut_short_is_not_published(tmp_path: Path) -> None:
    def write_half() -> None:
        with outputs.writing(tmp_path / "a.txt") as staged:
            staged.write_text("half")
            raise ValueError

    with Outputs(overwrite=True) as outputs:
        with pytest.raises(ValueError):  # noqa: PT011
            write_half()
        outputs.write(tmp_path / "b.txt", b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["b.txt"]


def test_several_folders_are_outputs_of_one_folder_also_after_one_that_was_dropped(tmp_path: Path) -> None:
    def write(outputs: Outputs, name: str, failing: bool = False) -> None:
        with outputs.writing_folder(tmp_path / name, _check) as folder:
            (folder / name).write_text(name)
            if failing:
                raise ValueError

    names = ("a.zarr", "b.zarr", "c_files", "c.zarr")
    with Outputs(overwrite=False) as outputs:
        for name in names:
            with pytest.raises(ValueError):  # noqa: PT011
                write(outputs, name, failing=True)
            write(outputs, name)
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} == {*names, *(f"{n}/{n}" for n in names)}


def test_of_two_outputs_in_one_place_neither_is_published(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path)

    def write() -> None:
        with Outputs(overwrite=True) as outputs:
            outputs.write(tmp_path / "a.txt", b"first")
            outputs.write(tmp_path / "link" / "a.txt", b"second")

    with pytest.raises(OutputError, match="is the name of two outputs"):
        write()
    assert [path.name for path in tmp_path.iterdir()] == ["link"]


@pytest.mark.parametrize("make", [lambda path: path.mkdir(), lambda path: path.touch()])
def test_what_only_has_the_name_of_a_leftover_stays(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / ".rdstitch-mine.part")
    write_bytes_atomic(tmp_path / "a.txt", b"x")
    assert (tmp_path / ".rdstitch-mine.part").exists()


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


def test_a_list_of_images_is_read_from_any_place(flight: str) -> None:
    fsspec.filesystem("memory").pipe("/flight/list.txt", f"{flight}/f9.jpg\n{flight}/f2.tif\n".encode())
    assert [str(frame.path) for frame in find_images([f"@{flight}/list.txt"]).frames] == [
        str(Path(f"{flight}/{name}")) for name in ("f9.jpg", "f2.tif")
    ]


def test_folder_and_pattern(flight: str) -> None:
    for named in (flight, f"{flight}/*"):
        assert [frame.path.name for frame in find_images([named]).frames] == ["f2.tif", "f9.jpg", "f10.png"]
    assert [frame.path.name for frame in find_images([f"{flight}/f?.*"]).frames] == ["f2.tif", "f9.jpg"]


def test_what_signs_an_address_is_no_pattern_and_no_name(flight: str) -> None:
    system, signature = fsspec.filesystem("memory"), "?X-Amz-Credential=a/b&X-Amz-Signature=[1]*"
    for name in ("/flight/f9.jpg", "/other/f9.jpg"):
        system.pipe(name + signature, system.cat("/flight/f9.jpg"))
    frames = find_images(
        [f"{flight}/f9.jpg{signature}", f"memory://other/f9.jpg{signature}", f"{flight}/f2.tif?a"]
    ).frames
    assert [frame.name for frame in frames] == ["flight/f9.jpg", "other/f9.jpg", "f2.tif"]
    assert read_metadata(frames[1].path).size == (60, 40)


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


def test_times_at_a_url_are_read_again_when_they_have_changed(flight: str) -> None:
    system = fsspec.filesystem("memory")
    for time in (5.0, 60.0):
        system.pipe("/flight/times.csv", f"name,timestamp\nf9.jpg,{time}\n".encode())
        assert time_of(Frame(Path("f9.jpg")), f"{flight}/times.csv") == time


def test_content_that_changes_during_the_run_is_noticed(flight: str) -> None:
    source = _source(f"{flight}/f9.jpg")
    source.read()
    system = fsspec.filesystem("memory")
    system.pipe("/flight/f9.jpg", system.cat("/flight/f9.jpg") + b"\0")
    with pytest.raises(InputError, match="has changed during the run"):
        source.read()


@pytest.mark.parametrize("told", ["ETag", "Last-Modified", "size"])
def test_what_changes_behind_one_web_address_is_not_what_was_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: str
) -> None:
    """The file system of HTTP has one key for an address, whatever lies there."""
    info = {"type": "file", "size": 5, told: 5}
    server = SimpleNamespace(protocol=("http", "https"), info=lambda name: info, ukey=lambda name: "address")
    monkeypatch.setattr("rdstitch.system.file_access._filesystem", lambda path: (server, path))
    url, cache = "https://host.org/a.jpg", Cache.at(tmp_path)
    kept, state = cache.file(url), content_state(url)
    assert content_state(url) == state
    assert (cache.file(url) == kept) == (told != "size")
    info[told] = 6
    assert cache.file(url) != kept
    assert content_state(url) != state


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
    with pytest.raises(InputError, match=r"URLs need fsspec: pip install 'fsspec\[http\]'"):
        read_metadata(Path("s3://bucket/a.jpg"))


@pytest.mark.parametrize("scheme", ["file://", "local://", "simplecache::file://"])
def test_what_is_read_by_a_url_of_this_machine_is_never_replaced(tmp_path: Path, scheme: str) -> None:
    image = tmp_path / "an image.png"
    image.write_bytes(b"the user's")
    for url in (f"{scheme}{image}", Path(f"{scheme}{image}")):
        with pytest.raises(OutputError, match="is read as input"):
            check_outputs([image], True, [url])
    check_outputs([image], True, ["memory://an image.png", "s3://bucket/a.png", "other.png"])
