"""What a start imports: SciPy's parts come when they are used, and what other commands run never does."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.running import flight

_UP_TO_THE_FIRST_IMAGE = """
import sys
from rdstitch.inputs import source
from rdstitch_cli.main import run

class Reached(BaseException):
    pass

def first(*_, **__):
    raise Reached

source.read_image = first
try:
    run(sys.argv[1:])
except Reached:
    pass
print(*sorted(sys.modules))
"""
_NOT_YET = (
    *("scipy", "tifffile", "tqdm", "matplotlib", "email"),
    *(
        "rdstitch.report",
        "rdstitch.doctor",
        "rdstitch.synthetic",
        "rdstitch.tracking",
        "rdstitch.camera_files",
        "rdstitch.stage",
    ),
)


@pytest.mark.parametrize("command", ["pano", "mosaic"])
def test_up_to_the_first_image_no_more_is_imported_than_it_takes(command: str, tmp_path: Path) -> None:
    frames = flight(2, 1).write(tmp_path)
    arguments = [command, *map(str, frames), "-o", str(tmp_path / "out.png"), "-j", "1"]
    done = subprocess.run(
        [sys.executable, "-c", _UP_TO_THE_FIRST_IMAGE, *arguments], capture_output=True, text=True, check=True
    )
    imported = done.stdout.split()
    assert "rdstitch.pipeline.recipes" in imported
    assert [
        name for name in imported if name.split(".")[0] in _NOT_YET or ".".join(name.split(".")[:2]) in _NOT_YET
    ] == []
