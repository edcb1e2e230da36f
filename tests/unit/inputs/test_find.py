"""What is not taken of folders, and videos among images."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rdstitch.errors import InputError
from rdstitch.inputs.find import find_images
from tests.videos import write_video


def images(folder: Path, count: int) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{k}.png" for k in range(count)]
    for path in paths:
        Image.new("L", (32, 24)).save(path)
    return paths


def video(path: Path) -> Path:
    return write_video(path, (np.full((48, 64, 3), 80 * k, np.uint8) for k in range(3)))


def test_what_is_no_image_in_a_folder_is_named_once(tmp_path: Path) -> None:
    images(tmp_path / "set", 2)
    (tmp_path / "set" / "notes.txt").write_text("x")
    (tmp_path / "set" / ".hidden").write_text("x")
    video(tmp_path / "set" / "clip.avi")
    found = find_images([tmp_path / "set"])
    assert [frame.path.name for frame in found.frames] == ["0.png", "1.png"]
    (message,) = found.messages
    assert message.severity == "detail"
    assert message.text.endswith("not taken for images: clip.avi, notes.txt")


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
