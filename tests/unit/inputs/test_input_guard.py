"""Inputs are guarded, decoded once, and taken as they arrive."""

import io
import os
import pickle
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from functools import partial
from io import BytesIO, StringIO, TextIOWrapper
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from rdstitch.errors import ArgumentError, InputError, LimitError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs import source as sources
from rdstitch.inputs.decoded_image_cache import DecodedImageCache
from rdstitch.inputs.frame import DeferredImage, Frame
from rdstitch.inputs.frame_stream import open_frame_stream
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io import read as reading
from rdstitch.io.mask import Mask
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage, read_image
from rdstitch.io.write import write_image
from rdstitch.system.cache import Cache
from tests.videos import write_video


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
    here.merge(same.state_of([path]))
    os.utime(path, ns=(0, 0))
    with later.reading(path):
        pass
    with pytest.raises(InputError, match=r"a\.bmp: has changed during the run"):
        here.merge(later.state_of([path]))


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


def test_an_image_that_needs_too_much_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.new("RGB", (1000, 500)).save(path)
    _source(path, max_memory=3_000_000)
    with pytest.raises(LimitError, match=r"a\.png: 1000 x 500 pixels need 3 MB .* --max-memory allows 3 MB"):
        _source(path, max_memory=2_999_999)


SIZE = (1500, 1000)  # halved once for a look at it


@pytest.fixture
def source(tmp_path: Path) -> Source:
    pixels = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
    write_image(tmp_path / "a.jpg", pixels)
    return Source(tmp_path / "a.jpg", Metadata(SIZE), Camera(SIZE))


def test_a_source_can_be_sent_elsewhere(source: Source) -> None:
    kept = replace(source, decoded_images=DecodedImageCache())
    kept.read(keep=True)
    for other in (pickle.loads(pickle.dumps(kept)), deepcopy(kept)):
        assert other == kept
        np.testing.assert_array_equal(other.read().pixels, kept.read().pixels)


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    seen: list[int] = []

    def noted(path: Path, reduction: int, metadata: Metadata) -> DecodedImage:
        seen.append(reduction)
        return read_image(path, reduction, metadata)

    monkeypatch.setattr(sources, "read_image", noted)
    return seen


def test_an_image_is_decoded_once_for_all_stages(source: Source, read: list[int]) -> None:
    shelved = replace(source, decoded_images=DecodedImageCache())
    looks = [shelved.read(reduction, keep=True).pixels for reduction in (2, 4, 8)]
    last = shelved.read(8).pixels
    assert read == [2]
    np.testing.assert_array_equal(last, looks[2])
    shelved.read(8)
    assert read == [2, 2]
    # A larger size is read from the file, and what is on the shelf changes no px.
    shelved = replace(source, decoded_images=DecodedImageCache())
    shelved.read(2, keep=True)
    assert shelved.read().pixels.shape == (SIZE[1], SIZE[0], 3)
    assert read[2:] == [2, 1]
    for reduction in (1, 2, 4, 8):
        with_shelf, without = (s.read(reduction, keep=True).pixels for s in (shelved, source))
        np.testing.assert_array_equal(with_shelf, without)


def test_tags_are_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    pixels = np.random.default_rng(0).integers(0, 256, (9, 16, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.jpg", exif=exif)
    source = read_sources([tmp_path / "a.jpg"], skip_bad=False)[0][0]
    expected = read_image(tmp_path / "a.jpg")
    monkeypatch.setattr(reading, "metadata_of", None)
    image = source.read()
    assert image.metadata is source.metadata
    np.testing.assert_array_equal(image.pixels, expected.pixels)


def test_masks_are_kept_apart(source: Source, tmp_path: Path) -> None:
    mask = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    mask[:600] = 0
    write_image(tmp_path / "mask.png", mask)
    shelved = replace(source, decoded_images=DecodedImageCache())
    masked = replace(shelved, mask=Mask(tmp_path / "mask.png"))
    assert shelved.read(2, keep=True).alpha is None
    alpha = masked.read(4, keep=True).alpha
    np.testing.assert_array_equal(alpha, np.repeat([0, 255], [150, 100])[:, None].repeat(375, axis=1))
    assert shelved.read(2).alpha is None


def test_images_for_which_there_is_no_room_are_not_kept() -> None:
    decoded_images = DecodedImageCache(capacity=250)
    large, small = (DecodedImage(np.zeros((10, n), np.uint8), None, Metadata((n, 10))) for n in (20, 5))
    decoded_images.put("large", large)
    decoded_images.put("other", large)
    decoded_images.put("small", small)
    copy = pickle.loads(pickle.dumps(decoded_images))
    copy.put("large", large)
    assert copy.take("large") is large
    assert decoded_images.take("other") is None
    assert decoded_images.take("large") is large
    assert decoded_images.take("large") is None
    decoded_images.put("other", large)
    assert decoded_images.take("other") is large
    assert decoded_images.take("small") is small


def _nowhere() -> Path:
    raise AssertionError("nothing needs to be written")


def _arriving(file: Path, level: int = 100) -> Path:
    assert cv2.imwrite(str(file), np.full((12, 16), level, np.uint8))
    return file


def _names(frames: Iterator[Frame]) -> list[str]:
    return [frame.path.name for frame in frames]


def test_what_is_in_a_folder_comes_in_natural_order_but_for_what_rdstitch_wrote(tmp_path: Path) -> None:
    for name in ("f10.png", "f9.png", ".hidden.png", "notes.txt", "out.png"):
        _arriving(tmp_path / name) if name.endswith("png") else (tmp_path / name).write_text("")
    (tmp_path / "out.png.json").write_text('{"format": "rdstitch sidecar", "output": {"file": "out.png"}}')
    arrivals = open_frame_stream(tmp_path, frames_folder=_nowhere, idle=0.5)
    assert _names(iter(arrivals)) == ["f9.png", "f10.png"]
    assert arrivals.inputs == [str(tmp_path)]


def test_names_that_do_not_come_are_waited_for_no_longer_than_that() -> None:
    reading, writing = os.pipe()
    try:
        os.write(writing, b"one.png\n\n")
        stream = os.fdopen(reading, encoding="utf-8", closefd=False)
        assert _names(iter(open_frame_stream("-", frames_folder=_nowhere, names=stream, idle=0.1))) == ["one.png"]
    finally:
        os.close(writing)
    with pytest.raises(ArgumentError, match="no list"):
        open_frame_stream("-", frames_folder=_nowhere)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Six frames, ever lighter, at 5 frames a second."""
    return write_video(tmp_path / "drive.avi", (np.full((48, 64, 3), 40 * level, np.uint8) for level in range(6)))


def test_every_nth_frame_of_a_video_with_its_number_and_time(video: Path) -> None:
    arrivals = open_frame_stream(video, frames_folder=_nowhere, every=2)
    frames = list(arrivals)
    assert [frame.number for frame in frames] == [0, 2, 4]
    assert [frame.timestamp for frame in frames] == pytest.approx([0.0, 0.4, 0.8])
    assert [frame.path.name for frame in frames] == ["drive_000000.png", "drive_000002.png", "drive_000004.png"]
    assert [int(np.median(frame.decoded().pixels)) for frame in frames] == pytest.approx([0, 80, 160], abs=3)
    assert arrivals.inputs == [str(video)]


def test_frames_of_a_stream_are_kept_since_they_come_only_once(video: Path, tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    folder.mkdir()
    arrivals = open_frame_stream(f"file://{video}", frames_folder=lambda: folder)
    frames = list(arrivals)
    if not frames:
        pytest.skip("this OpenCV opens no addresses")
    kept = [frame for frame in arrivals.inputs if isinstance(frame, Frame)]
    assert [frame.number for frame in kept] == [0, 1, 2, 3, 4, 5]
    assert all(frame.path.parent == folder and frame.path.exists() for frame in kept)
    assert [frame.timestamp for frame in kept] == [frame.timestamp for frame in frames]


def test_what_cannot_be_followed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be followed"):
        open_frame_stream(tmp_path / "nothing", frames_folder=_nowhere)
    with pytest.raises(InputError, match="cannot be followed"):
        open_frame_stream(_arriving(tmp_path / "image.png"), frames_folder=_nowhere)
    with pytest.raises(InputError, match="cannot open"):
        next(iter(open_frame_stream("tcp://127.0.0.1:9", frames_folder=_nowhere)))
    empty = io.StringIO("")
    assert list(open_frame_stream("-", frames_folder=_nowhere, names=empty)) == []


@pytest.mark.parametrize("names", [b"a.jpg\nb\xff.jpg\r\n\nc.jpg", "a.jpg\nb\udcff.jpg\nc.jpg\n"])
def test_names_need_not_be_utf8(names: bytes | str) -> None:
    stream = StringIO(names) if isinstance(names, str) else TextIOWrapper(BytesIO(names), encoding="utf-8")
    arrivals = open_frame_stream("-", frames_folder=Path, names=stream)
    assert [os.fsencode(frame.path) for frame in arrivals] == [b"a.jpg", b"b\xff.jpg", b"c.jpg"]


def test_planes_of_one_file_are_images_of_their_own(tmp_path: Path) -> None:
    metadata = Metadata((3, 2))
    planes = [DecodedImage(np.full((2, 3), level, np.uint8), None, metadata) for level in (1, 2)]
    frames = [Frame(Path("stack.tif"), image=DeferredImage(metadata, partial(deepcopy, plane))) for plane in planes]
    read, _ = read_sources(frames, skip_bad=False)
    for _ in range(2):  # of the second time from where they are kept
        assert [int(source.read(keep=True).pixels.max()) for source in read] == [1, 2]
    for cache in (Cache.at(tmp_path), Cache.for_this_run(tmp_path)):
        assert len({source.content(cache) for source in read}) == 2
