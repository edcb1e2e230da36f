"""The stitchers that are compared end to end, as a user would run them, within limits of time and memory."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

_LAUNCHER = Path(__file__).with_name("launcher.py")
_MAX_MEMORY = 8 << 30  # bytes of address space: a mosaic that runs away must not take the machine with it
_SAID = 120  # characters of a program's last line that are kept


@dataclass(frozen=True)
class Run:
    """What became of one or several programs run one after the other."""

    status: int | None  # exit status of the last one that ran; negative for a signal, None when the time was up
    seconds: float  # wall time
    processor_seconds: float  # processor time of all of them; of one that was ended, without what its own children used
    megabytes: float  # largest resident memory of any of them, 10⁶ bytes
    said: str  # last line on standard error

    @property
    def ok(self) -> bool:
        """Whether the last one succeeded, and with it all."""
        return self.status == 0


def run_all(commands: Sequence[Sequence[str]], folder: Path, timeout: float) -> Run:
    """Run commands one after the other until one fails or the time is up.

    ``folder``: working directory. ``timeout``: seconds for all of them.
    """
    begun = time.perf_counter()
    status: int | None = 0
    processor, megabytes, said = 0.0, 0.0, ""
    for command in commands:
        left = timeout - (time.perf_counter() - begun)
        launched = [sys.executable, "-I", "-S", str(_LAUNCHER), str(left), str(_MAX_MEMORY), *command]
        done = subprocess.run(launched, cwd=folder, capture_output=True, text=True, errors="replace", check=True)
        told = json.loads(done.stdout)
        status, lines = told["status"], done.stderr.strip().splitlines()
        processor += told["processor_seconds"]
        megabytes = max(megabytes, told["kilobytes"] / 1e3)
        said = lines[-1][:_SAID] if lines else ""
        if status != 0:
            break
    return Run(status, time.perf_counter() - begun, processor, megabytes, said)


_ROOT = Path(__file__).resolve().parents[3]
_HUGIN = ["pto_gen", "cpfind", "cpclean", "pto_var", "autooptimiser", "pano_modify"]
_HUGIN += ["hugin_executor", "nona", "enblend"]


@dataclass(frozen=True)
class Stitcher:
    """A program that makes a mosaic of images.

    ``commands``: takes the images, the file to write, and the horizontal field of view in degrees, which only the
    hand-written recipe looks at; gives the commands.
    """

    name: str
    commands: Callable[[Sequence[Path], Path, float], list[list[str]]]


def installed_stitchers(peer_python: str | None) -> tuple[list[Stitcher], tuple[str, ...]]:
    """The stitchers that are here, and a note for each that is not.

    ``peer_python``: Python that has the package stitching; this one if not given.
    """
    found = [
        Stitcher("rdstitch mosaic", _worker(sys.executable, "rdstitch")),
        Stitcher("OpenCV Stitcher, PANORAMA", _worker(sys.executable, "opencv_panorama")),
        Stitcher("OpenCV Stitcher, SCANS", _worker(sys.executable, "opencv_scans")),
    ]
    notes = []
    python = peer_python or sys.executable
    if _imports(python, "stitching"):
        found.append(Stitcher("stitching, Stitcher", _worker(python, "stitching_rotation")))
        found.append(Stitcher("stitching, AffineStitcher", _worker(python, "stitching_affine")))
    else:
        notes.append("the package stitching is not installed and was left out")
    missing = [program for program in _HUGIN if shutil.which(program) is None]
    if missing:
        notes.append(f"Hugin is not installed and was left out ({', '.join(missing)} not found)")
    else:
        found.append(Stitcher("Hugin, automatic", _hugin_automatic))
        found.append(Stitcher("Hugin, hand-written recipe", _hugin_by_hand))
    return found, tuple(notes)


def installed_panorama_stitchers(peer_python: str | None) -> tuple[list[Stitcher], tuple[str, ...]]:
    """The same for panoramas of a camera that turns, all on the sphere."""
    own = Stitcher("rdstitch mosaic", _worker(sys.executable, "rdstitch_sphere"))
    others, notes = installed_stitchers(peer_python)
    chosen = [peer for peer in others if peer.name in ("OpenCV Stitcher, PANORAMA", "stitching, Stitcher")]
    if any(peer.name.startswith("Hugin") for peer in others):
        chosen.append(Stitcher("Hugin, automatic", _hugin_sphere))
    return [own, *chosen], notes


def _imports(python: str, module: str) -> bool:
    done = subprocess.run([python, "-c", f"import {module}"], capture_output=True, check=False)
    return done.returncode == 0


def _worker(python: str, name: str) -> Callable[[Sequence[Path], Path, float], list[list[str]]]:
    """One of :mod:`examples.paper.common.stitch_worker`."""
    start = f"import sys; sys.path.insert(0, {str(_ROOT)!r}); from examples.paper.common.stitch_worker import main"
    code = f"{start}; sys.exit(main(sys.argv[1:]))"
    return lambda images, output, _: [[python, "-c", code, name, str(output), *map(str, images)]]


def _hugin_automatic(images: Sequence[Path], output: Path, _: float) -> list[list[str]]:
    """What Hugin does of its own: its assistant, from the images alone."""
    return [
        ["pto_gen", "-o", "a.pto", *map(str, images)],
        ["hugin_executor", "--assistant", "a.pto"],
        ["hugin_executor", "--stitching", f"--prefix={output.stem}", "a.pto"],
    ]


def _hugin_sphere(images: Sequence[Path], output: Path, field_of_view: float) -> list[list[str]]:
    """The assistant, and the whole of what it has made on the sphere."""
    generate, assist, stitch = _hugin_automatic(images, output, field_of_view)
    project = ["pano_modify", "--projection=2", "--fov=AUTO", "--canvas=AUTO", "--crop=AUTO", "-o", "a.pto", "a.pto"]
    return [generate, assist, project, stitch]


def _hugin_by_hand(images: Sequence[Path], output: Path, field_of_view: float) -> list[list[str]]:
    """For a flat scene: the true field of view, positions first, then tilts, heights and distortion as well."""
    others = range(1, len(images))
    plane = ",".join(f"r{i},TrX{i},TrY{i}" for i in others)
    everything = ",".join(["y0,p0,b0", plane, *(f"y{i},p{i},TrZ{i}" for i in others)])
    return [
        ["pto_gen", "-p", "0", "-f", f"{field_of_view:.3f}", "-o", "a.pto", *map(str, images)],
        ["cpfind", "--multirow", "-o", "a.pto", "a.pto"],
        ["cpclean", "-o", "a.pto", "a.pto"],
        ["pto_var", f"--opt={plane}", "-o", "a.pto", "a.pto"],
        ["autooptimiser", "-n", "-o", "a.pto", "a.pto"],
        ["pto_var", f"--opt={everything}", "-o", "a.pto", "a.pto"],
        ["autooptimiser", "-n", "-o", "a.pto", "a.pto"],
        ["pano_modify", "--projection=0", "--fov=AUTO", "--canvas=AUTO", "-o", "a.pto", "a.pto"],
        ["hugin_executor", "--stitching", f"--prefix={output.stem}", "a.pto"],
    ]
