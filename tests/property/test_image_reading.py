"""Whatever an image file holds, reading it gives an image or one line that names the file.

``pytest --hypothesis-profile long tests/property`` asks for as long as patience lasts.
"""

import io
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from rdstitch.errors import InputError
from rdstitch.io.metadata import Metadata, read_metadata
from rdstitch.io.read import DecodedImage, read_image

_XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:GimbalYawDegree="+12.5" '
    b'drone-dji:GimbalPitchDegree="-90.0" drone-dji:GimbalRollDegree="0" Camera:Yaw="3" '
    b'drone-dji:CalibratedFocalLength="3666.6"><Pitch>1e999</Pitch></rdf:Description></x:xmpmeta>'
)


def _exif() -> Image.Exif:
    """Every tag that is read."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "Maker", "Model", 6
    photo = exif.get_ifd(0x8769)
    photo[0x920A], photo[0xA20E], photo[0xA210], photo[0xA405] = 4.5, 100.0, 3, 24
    photo[0xA431], photo[0xA002], photo[0xA003], photo[0x927C] = "serial", 24, 16, b"note"
    place = exif.get_ifd(0x8825)
    place[1], place[2], place[3], place[4], place[5], place[6] = (
        "N",
        (52.0, 30.0, 1.5),
        "W",
        (1.0, 2.0, 3.0),
        b"\1",
        80.0,
    )
    return exif


def _encoded(kind: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    samples = np.random.default_rng(3).integers(0, 256, (16, 24, 3), dtype=np.uint8)
    Image.fromarray(samples).save(stream, kind, exif=_exif(), **options)
    return stream.getvalue()


def _text() -> PngInfo:
    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", _XMP.decode())
    return text


FILES = {
    "jpg": _encoded("JPEG", xmp=_XMP, dpi=(300, 300)),
    "png": _encoded("PNG", pnginfo=_text()),
    "tif": _encoded("TIFF"),
    "deflated.tif": _encoded("TIFF", compression="tiff_adobe_deflate"),
    "webp": _encoded("WEBP", xmp=_XMP),
}


@st.composite
def _damaged(draw: st.DrawFn, good: bytes) -> bytes:
    """A file with a few of its bytes changed, or stretches cut out or doubled; most of it still holds together."""
    data = bytearray(good)
    for _ in range(draw(st.integers(1, 5))):
        # The first part is where everything but pixels is.
        at = draw(st.integers(0, min(len(data), 700) - 1) | st.integers(0, len(data) - 1))
        what = draw(st.sampled_from(["byte", "byte", "number", "cut", "double", "end"]))
        if what == "byte":
            data[at] = draw(st.sampled_from([0, 1, 127, 128, 254, 255]) | st.integers(0, 255))
        elif what == "number":
            data[at : at + 4] = draw(
                st.sampled_from([b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\0\0\0\1"])
            )
        elif what == "cut":
            del data[at : at + draw(st.integers(1, 40))]
        elif what == "double":
            data[at:at] = data[at : at + draw(st.integers(1, 40))]
        elif at > 20:
            del data[at:]
        if len(data) < 8:
            return bytes(data) + b"\0"
    return bytes(data)


def _reads_or_complains(
    read: Callable[[Path], Metadata | DecodedImage], content: bytes
) -> Metadata | DecodedImage | None:
    found, complaint = None, ""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "image"
        file.write_bytes(content)
        try:
            found = read(file)
        except InputError as error:
            complaint = str(error)
    assert (found is None) == (str(file) in complaint)
    assert "\n" not in complaint
    return found


@pytest.mark.parametrize("kind", FILES)
def test_the_good_ones_tell_all(kind: str) -> None:
    found = _reads_or_complains(read_metadata, FILES[kind])
    assert isinstance(found, Metadata)
    assert (found.make, found.model) == ("Maker", "Model")
    if "tif" in kind:
        return  # what writes them leaves out the rest
    assert (found.serial, found.size) == ("serial", (16, 24))
    assert found.gps.altitude == -80.0


@pytest.mark.parametrize("kind", FILES)
@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.too_slow], deadline=None)
def test_damaged_images(kind: str, data: st.DataObject) -> None:
    content = data.draw(_damaged(FILES[kind]))
    metadata = _reads_or_complains(read_metadata, content)
    if isinstance(metadata, Metadata):
        assert min(metadata.size) >= 1
        assert metadata.focal_px is None or 0 < metadata.focal_px < float("inf")
        # Fields that claim an enormous image cost nothing to say and much to try.
        if metadata.size[0] * metadata.size[1] > 10**6:
            return
    image = _reads_or_complains(read_image, content)
    if isinstance(image, DecodedImage):
        assert image.pixels.size > 0
        assert np.isfinite(image.pixels).all()
