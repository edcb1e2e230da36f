"""The command line, run in this process or as a stranger runs it, and small images to run it on."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from jsonschema import Draft202012Validator

from rdstitch.arrays import FloatArray
from rdstitch.features import FeatureOptions
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.camera_record import CameraRecord
from rdstitch.geometry.radial_homography import project
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.sidecar.read import json_schema
from rdstitch.synthetic import Photometry, RenderedSequence, grid_poses, ground, sequence_over
from rdstitch.system.records import convert


def _closed(schema: dict[str, Any]) -> dict[str, Any]:
    """The schema of sidecars that have no field besides its own; options are checked by their own rules."""
    for name, record in schema["$defs"].items():
        if record.get("type") == "object" and name != "OptionsRecord":
            record["additionalProperties"] = False
    return schema


SIDECAR_SCHEMA = Draft202012Validator(_closed(json_schema()))

# A shell ignores interrupts for what it runs in the background, these tests for one, and children inherit that.
_PROGRAM = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from rdstitch_cli.main import main
main()
"""

DISTORTION = -0.2

# Small images need no more, and every command of these tests takes a second less.
FAST = ("-j", "1", "--max-features", "600")

_cache = tempfile.TemporaryDirectory(prefix="rdstitch-tests-")

# For tests of what comes before and after registration: the same images are registered once in a process of tests.
CACHE = ("--cache", _cache.name)
CACHED = (*FAST, *CACHE)
OPTIONS = StitchOptions(workers=1, features=FeatureOptions(max_features=600), cache=Path(_cache.name))
"""What ``CACHED`` says, for the library."""


_MADE = re.compile(r", \d+\.\d s$")


@dataclass(frozen=True)
class Outcome:
    """What a run of the command line left behind; ``made`` is the last line of a success, which ``err`` is without."""

    status: int
    out: str
    err: str
    made: str = ""

    @classmethod
    def of(cls, status: int, out: str, err: str) -> Self:
        """With the last line taken off."""
        lines = err.splitlines(keepends=True)
        if status == 0 and lines and _MADE.search(lines[-1]):
            return cls(status, out, "".join(lines[:-1]), lines[-1].rstrip("\n"))
        return cls(status, out, err)

    @property
    def line(self) -> str:
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        return lines[0]


Run = Callable[..., Outcome]
"""The fixture ``rdstitch``."""


def flight(
    seed: int, columns: int, rows: int = 1, distortion: float = DISTORTION, overlap: float = 0.5
) -> RenderedSequence:
    lens = Camera((400, 300), distortion=distortion, focal=380.0)
    poses = grid_poses(lens, columns, rows, overlap=overlap, yaw=0.1, shift=0.05, tilt=(0.05, -0.03), seed=seed)
    return sequence_over(partial(ground, seed=seed), lens, poses, photometry=Photometry(noise=0.01), seed=seed)


def start(
    *arguments: str | Path,
    stdin: int = subprocess.DEVNULL,
    program: str = _PROGRAM,
    environment: Mapping[str, str] | None = None,
) -> "subprocess.Popen[bytes]":
    """Start the command line as a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "OMP_NUM_THREADS": "1", **(environment or {})},
    )


def finished(process: "subprocess.Popen[bytes]", data: bytes | None = None) -> Outcome:
    out, err = process.communicate(data, timeout=300)
    assert b"Traceback" not in err, err.decode("utf-8", "replace")
    return Outcome.of(process.returncode, out.decode("utf-8", "replace"), err.decode("utf-8", "replace"))


def rows_of(table: Path) -> list[dict[str, str]]:
    with table.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def state_of(folder: Path) -> dict[str, bytes | None]:
    """Every file with its content."""
    return {
        os.fsencode(path.relative_to(folder)).decode("latin-1"): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def copied(files: Iterable[Path], folder: Path, *names: str) -> list[Path]:
    """Copies under these names, or their own, in a folder that is made where it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    named = zip(files, names, strict=False) if names else ((file, file.name) for file in files)
    return [Path(shutil.copy(file, folder / name)) for file, name in named]


def shown(path: Path) -> str:
    """A name as it appears within a line."""
    return str(path).encode("utf-8", "backslashreplace").decode("utf-8").replace("\n", " ")


def sidecar_of(output: str | Path) -> dict[str, Any]:
    """What lies beside an output."""
    record: dict[str, Any] = json.loads(Path(f"{output}.json").read_text(encoding="utf-8"))
    return record


def check_sidecar(file: Path) -> None:
    """A sidecar, where there is one, must be what the schema says."""
    if file.is_file():
        SIDECAR_SCHEMA.validate(json.loads(file.read_text(encoding="utf-8")))


def transfers(record: dict[str, Any]) -> Mapping[int, Callable[[FloatArray], FloatArray]]:
    """By its sidecar: where each image's measured px lie in the output, for the images that were used."""
    camera = record["camera"]
    found = {}
    for index, image in enumerate(record["images"]):
        if image["used"]:
            width, height = image["size"]
            lens = convert({**camera, "image_size": [width, height]}, CameraRecord, "sidecar").camera()
            found[index] = partial(_to_output, lens, np.array(image["to_output"]))
    return found


def _to_output(lens: Camera, matrix: FloatArray, points: FloatArray) -> FloatArray:
    flat = lens.normalize(lens.undistort(points))
    return project(np.column_stack([flat, np.ones(len(flat))]) @ (matrix * np.sign(matrix[2, 2])).T)
