"""Images as they arrive."""

import os
from io import BytesIO, StringIO, TextIOWrapper
from pathlib import Path

import pytest

from rdstitch.inputs.arrivals import Arrivals


@pytest.mark.parametrize("names", [b"a.jpg\nb\xff.jpg\r\n\nc.jpg", "a.jpg\nb\udcff.jpg\nc.jpg\n"])
def test_names_need_not_be_utf8(names: bytes | str) -> None:
    stream = StringIO(names) if isinstance(names, str) else TextIOWrapper(BytesIO(names), encoding="utf-8")
    arrivals = Arrivals("-", frames_folder=Path, names=stream)
    assert [os.fsencode(frame.path) for frame in arrivals] == [b"a.jpg", b"b\xff.jpg", b"c.jpg"]
