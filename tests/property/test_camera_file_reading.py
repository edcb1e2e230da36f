"""Whatever a camera file holds, reading it gives a camera or one line that names the file."""

import json
import re
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rdstitch.camera import Camera
from rdstitch.camera_files import load_camera, save_camera
from rdstitch.errors import InputError
from tests.damaged_texts import damaged, damaged_text


def _good(name: str, own: bool) -> str:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        save_camera(Camera((400, 300), -0.2, focal=380.0, focal_source="file"), file)
        text = file.read_text(encoding="utf-8")
    if own:
        return text
    text = re.sub(r"(?m)^#rdstitch .*\n|^rdstitch:\n(?: +.*\n)*", "", text)
    return re.sub(r',\s*"rdstitch": \{[^}]*\}', "", text)


TEXTS = [
    _good(name, own) for name in ("c.json", "c.yml", "opencv.json", "cameras.json", "c.pto") for own in (False, True)
]
OBJECTS = [json.loads(text) for text in TEXTS if text.startswith("{")]


def _reads_or_complains(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "camera"
        file.write_bytes(content)
        complaint = ""
        try:
            camera = load_camera(file)
            assert camera.image_size[0] > 0
        except InputError as error:
            complaint = str(error)
        assert not complaint or str(file) in complaint


@pytest.mark.parametrize("text", TEXTS)
def test_good_ones_are_read(text: str, tmp_path: Path) -> None:
    (tmp_path / "camera").write_text(text, encoding="utf-8")
    assert load_camera(tmp_path / "camera").distortion == pytest.approx(-0.2, abs=1e-3)


@settings(deadline=None)
@given(st.sampled_from(OBJECTS).flatmap(damaged))
def test_damaged_fields(content: object) -> None:
    _reads_or_complains(json.dumps(content).encode("utf-8", "surrogatepass"))


@settings(deadline=None)
@given(st.binary(max_size=100) | st.sampled_from(TEXTS).flatmap(damaged_text))
def test_damaged_text(content: bytes) -> None:
    _reads_or_complains(content)
