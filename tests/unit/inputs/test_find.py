"""Finding the inputs, and choosing among them."""

import re
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from PIL import Image

from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.find import find_images
from rdstitch.inputs.frame import Frame, as_inputs
from rdstitch.inputs.image_folders import natural_key
from rdstitch.inputs.rosbag import _ENCODINGS, _eight_bits, _grey_of_compressed, _pixels
from rdstitch.inputs.selection import selected
from rdstitch.inputs.source import read_sources
from rdstitch.io import video as video_reader
from tests.videos import write_video


def images(folder: Path, count: int) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{k}.png" for k in range(count)]
    for path in paths:
        Image.new("L", (32, 24)).save(path)
    return paths


def test_names_of_one_number_have_one_order() -> None:
    names = [Path(name) for name in ("img2.png", "img1.png", "img01.png", "img001.png")]
    orders = {tuple(sorted(some, key=natural_key)) for some in permutations(names)}
    assert len(orders) == 1
    assert orders.pop()[-1].name == "img2.png"


@pytest.mark.parametrize("order", "<>")
def test_samples_of_either_byte_order_are_taken(order: str) -> None:
    samples = np.arange(48, dtype=f"{order}u2").reshape(4, 6, 2)
    (frame,) = as_inputs(samples)
    assert isinstance(frame, Frame)
    assert frame.decoded().pixels.dtype == np.uint16
    np.testing.assert_array_equal(frame.decoded().pixels, samples[..., 0])


def video(path: Path) -> Path:
    return write_video(path, (np.full((48, 64, 3), 80 * k, np.uint8) for k in range(3)))


def test_what_is_no_image_in_a_folder_is_named_once(tmp_path: Path) -> None:
    images(tmp_path / "set", 2)
    (tmp_path / "set" / "notes.txt").write_text("x")
    (tmp_path / "set" / ".hidden").write_text("x")
    Image.new("L", (32, 24)).save(tmp_path / "set" / "x.png")
    (tmp_path / "set" / "X.CR2").write_bytes(b"the same image")
    video(tmp_path / "set" / "clip.avi")
    found = find_images([tmp_path / "set"])
    assert [frame.path.name for frame in found.frames] == ["0.png", "1.png", "x.png"]
    assert {message.severity for message in found.messages} == {"detail"}
    versions, others = (message.text for message in found.messages)
    assert versions.endswith("are raw or HEIC versions of images that are taken: X.CR2")
    assert others.endswith("not taken for images: clip.avi, notes.txt")


def test_the_folders_or_the_video_in_a_folder_without_images_are_named(tmp_path: Path) -> None:
    images(tmp_path / "set" / "a", 2)
    (tmp_path / "set" / "empty").mkdir()
    with pytest.raises(InputError, match=r"no images in this folder, but in the folders within it; name .*set/a$"):
        find_images([tmp_path / "set"])
    video(tmp_path / "set" / "empty" / "clip.avi")
    with pytest.raises(InputError, match=r"no images in this folder, but a video; name it: .*clip\.avi$"):
        find_images([tmp_path / "set" / "empty"])


def test_a_video_among_images_is_used_only_when_asked_for(tmp_path: Path) -> None:
    paths, clip = images(tmp_path, 2), video(tmp_path / "clip.avi")
    (tmp_path / "frames").mkdir()

    def folder() -> Path:
        return tmp_path / "frames"

    found = find_images([clip, *paths], frames_folder=folder)
    assert [frame.path for frame in found.frames] == paths
    (message,) = found.messages
    assert str(message).startswith("clip.avi: is a video among images, and was not used; ")
    assert list(folder().iterdir()) == []
    asked = find_images([clip, *paths], frames_folder=folder, every=1)
    assert len(asked.frames) == 5
    assert asked.messages == []
    assert len(find_images([clip], frames_folder=folder).frames) > 0
    with pytest.raises(InputError, match=r"clip\.avi: is a video beside one image"):
        find_images([clip, paths[0]], frames_folder=folder)


def test_a_video_that_was_cut_off_is_told(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (40, 48, 64, 3), dtype=np.uint8)
    clip = write_video(tmp_path / "whole.avi", noise)
    (tmp_path / "cut.avi").write_bytes(clip.read_bytes()[: clip.stat().st_size // 2])
    for name, texts in (("whole", []), ("cut", ["ends after N of 40 frames; copy it again from its source"])):
        found = find_images([tmp_path / f"{name}.avi"], frames_folder=lambda: tmp_path, every=3)
        assert [re.sub(r"after \d+", "after N", message.text) for message in found.messages] == texts
        assert (len(found.frames) == 14) == (not texts)


@pytest.mark.parametrize("name", ["", "@"])
def test_an_empty_name_is_not_the_current_folder(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images(tmp_path, 2)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="one of the names of images is empty" if not name else "cannot be read"):
        find_images([name])


def test_videos_of_one_name_are_filed_apart(tmp_path: Path) -> None:
    frames = [np.full((48, 64, 3), 20 * k, np.uint8) for k in range(8)]
    clips = []
    for name, shown in (("cam0/drive.avi", frames[:4]), ("cam1/drive.avi", frames[4:])):
        (tmp_path / name).parent.mkdir()
        clips.append(write_video(tmp_path / name, shown))
    found = find_images(clips, frames_folder=lambda: tmp_path, every=1).frames
    grey = [int(np.asarray(Image.open(frame.path)).mean()) for frame in found]
    assert grey == pytest.approx([20 * k for k in range(8)], abs=4)
    assert [frame.name for frame in found] == [f"cam{k // 4}/drive_{k % 4:06d}.png" for k in range(8)]
    # The same file by two names is one video.
    twice = find_images([clips[0], clips[0]], frames_folder=lambda: tmp_path, every=1).frames
    assert len(read_sources(twice, skip_bad=False)[0]) == 4


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["a/x.png", "b/x.png", "b/y.png"], ["a/x.png", "b/x.png", "y.png"]),
        (["1/left/x.png", "2/left/x.png"], ["1/left/x.png", "2/left/x.png"]),
        (["a/x.png", "a/../a/x.png"], ["x.png", "x.png"]),
    ],
)
def test_images_of_one_name_are_called_by_their_folders(files: list[str], names: list[str], tmp_path: Path) -> None:
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    frames = find_images([tmp_path / file for file in files]).frames
    assert [frame.name for frame in frames] == names
    assert [frame.name for frame in selected(frames, [names[0]], [])] == [n for n in names if n != names[0]]


FRAMES = [Frame(Path("flight") / name, index) for index, name in enumerate(("a1.jpg", "a2.jpg", "b1.jpg", "b[2].jpg"))]


def _names(exclude: tuple[str, ...] = (), include_only: tuple[str, ...] = ()) -> list[str]:
    return [frame.path.name for frame in selected(FRAMES, exclude, include_only)]


@pytest.mark.parametrize(
    ("exclude", "include_only", "left"),
    [
        ((), (), ["a1.jpg", "a2.jpg", "b1.jpg", "b[2].jpg"]),
        (("a1.jpg",), (), ["a2.jpg", "b1.jpg", "b[2].jpg"]),
        (("a*", "b1.jpg"), (), ["b[2].jpg"]),
        (("flight/a?.jpg",), (), ["b1.jpg", "b[2].jpg"]),
        ((), ("a*", "b1*"), ["a1.jpg", "a2.jpg", "b1.jpg"]),
        (("a1*",), ("a*",), ["a2.jpg"]),
        (("b[2].jpg",), (), ["a1.jpg", "a2.jpg", "b1.jpg"]),
    ],
)
def test_images_are_chosen_by_name(exclude: tuple[str, ...], include_only: tuple[str, ...], left: list[str]) -> None:
    assert _names(exclude, include_only) == left


def test_a_name_that_is_none_is_refused() -> None:
    with pytest.raises(ArgumentError, match=r"--exclude c.jpg: none of the 4 images"):
        _names(("c.jpg",))
    with pytest.raises(ArgumentError, match=r"--include-only c.jpg: none of the 4 images"):
        _names((), ("c.jpg",))


_NOISE = np.random.default_rng(0).integers(0, 65536, (60, 80), dtype=np.uint16)
SMOOTH = np.asarray(cv2.GaussianBlur(_NOISE, (0, 0), 3), dtype=np.uint16)


def test_compressed_images_are_decoded() -> None:
    grey = (SMOOTH >> 8).astype(np.uint8)
    for suffix, samples, off in ((".png", grey, 0), (".png", SMOOTH, 0), (".jpg", grey, 4)):
        found = _grey_of_compressed(cv2.imencode(suffix, samples)[1])
        assert np.abs(found.astype(int) - samples).max() <= off


def _message(encoding: str, samples: np.ndarray, padding: int = 0, *, big: bool = False) -> SimpleNamespace:
    """A message of ROS with an image (H, W, C), whose rows end with some bytes more or less."""
    height, width, _ = samples.shape
    rows = samples.astype(samples.dtype.newbyteorder(">" if big else "<")).reshape(height, -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, max(padding, 0))))[:, : rows.shape[1] + padding]
    size = {"height": height, "width": width, "step": rows.shape[1]}
    return SimpleNamespace(encoding=encoding, is_bigendian=big, data=rows.ravel(), **size)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("encoding", _ENCODINGS)
def test_uncompressed_images_are_read_in_every_encoding(encoding: str, big: bool) -> None:
    kind = np.uint16 if "16" in encoding else np.uint8
    bgra = np.random.default_rng(3).integers(0, np.iinfo(kind).max, (6, 8, 4), dtype=kind)
    if pattern := re.fullmatch("bayer_(....)8", encoding):
        bgra[:] = bgra[0, 0]
        samples = np.tile(bgra[0, 0, ["bgr".index(letter) for letter in pattern[1]]].reshape(2, 2), (3, 4))[..., None]
    else:
        channels = {"C1": "b", "C3": "bgr", "C4": "bgra"}.get(encoding[-2:], encoding.rstrip("0123456789"))
        samples = bgra[..., ["bgra".index(letter) for letter in channels.replace("mono", "b")]]
    found = _pixels(Path("a.bag"), _message(encoding, samples, 4, big=big))
    np.testing.assert_array_equal(found, bgra[..., :3] if found.ndim == 3 else bgra[..., 0])
    assert (found.ndim == 3) == (pattern is not None or samples.shape[2] > 1)


@pytest.mark.parametrize(("encoding", "missing"), [("mono8", 1), ("mono16", 8), ("bayer_rggb8", 2), ("bgr8", 3)])
def test_rows_that_are_too_short_for_an_image_are_refused(encoding: str, missing: int) -> None:
    kind, channels, _ = _ENCODINGS[encoding]
    message = _message(encoding, np.zeros((6, 8, channels), kind), -missing)
    with pytest.raises(InputError, match=rf"a\.bag: rows of {message.step} bytes are too short for 8 pixels"):
        _pixels(Path("a.bag"), message)


@pytest.mark.parametrize("rows", [0, 3])
def test_images_with_too_few_bytes_are_refused(rows: int) -> None:
    message = _message("mono16", np.zeros((6, 8, 1), np.uint16))
    message.data = message.data[: rows * message.step]
    with pytest.raises(InputError, match=rf"a\.bag: {rows * 16} bytes are too few for 6 rows of 16"):
        _pixels(Path("a.bag"), message)


def test_of_a_deep_image_eight_bits_are_the_same_at_any_exposure() -> None:
    dark, bright = (_eight_bits((SMOOTH >> by).astype(np.uint16)) for by in (6, 2))
    assert dark.max() == bright.max() == 255
    assert np.abs(dark.astype(int) - bright).max() <= 2
    assert not _eight_bits(np.zeros((8, 8), np.uint16)).any()


def test_damaged_images_are_none_or_what_is_left_without_a_word(capfd: pytest.CaptureFixture[str]) -> None:
    for suffix in (".jpg", ".png"):
        data = cv2.imencode(suffix, (SMOOTH >> 8).astype(np.uint8))[1].copy()
        _grey_of_compressed(data[: len(data) // 2])
        data[len(data) // 2 : len(data) // 2 + 9] = 7
        _grey_of_compressed(data)
    assert _grey_of_compressed(np.frombuffer(b"no image", np.uint8)) is None
    assert capfd.readouterr().err == ""


def test_frames_that_cannot_be_decoded_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = video(tmp_path / "clip.avi")

    def capture(number: int) -> Mock:
        decoded = (True, np.zeros((48, 64, 3), np.uint8)) if number != 1 else (False, None)
        return Mock(get={cv2.CAP_PROP_FRAME_COUNT: 3.0, cv2.CAP_PROP_FPS: 25.0}.get, retrieve=lambda: decoded)

    monkeypatch.setattr(video_reader, "grabbed_frames", lambda path: ((k, k / 25.0, capture(k)) for k in range(3)))
    found = find_images([clip], frames_folder=lambda: tmp_path, every=1)
    assert len(found.frames) == 2
    assert [message.text for message in found.messages] == ["1 frame cannot be decoded and is left out"]
