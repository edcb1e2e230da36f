"""Does any parser do anything with a damaged file but read it, or complain in one line that names it?

python -m tests.benchmarks.fuzz [--minutes 10] [--seed 0] [--only sidecar] [--keep FOLDER]

Good files are damaged at random: bits and bytes, numbers, words and lines changed, swapped, doubled, cut out, ends cut
off, deep nesting put in. Each parser runs in a process of its own, so that a crash of a decoder is seen too; what a
parser stumbles over is kept.
"""

import argparse
import io
import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from PIL import Image
from rdstitch_cli.config import read_config
from rdstitch_cli.main import cli
from rdstitch_cli.terminal import one_line

from rdstitch.camera import Camera
from rdstitch.camera_files import load_camera
from rdstitch.errors import RdstitchError
from rdstitch.inputs.find import find_images
from rdstitch.inputs.measurements import with_attitudes
from rdstitch.inputs.source import Source
from rdstitch.io import read_image, read_metadata, write_image
from rdstitch.io.deepzoom import holds_only_tiles
from rdstitch.io.mask import read_mask
from rdstitch.io.metadata import Metadata, metadata_of
from rdstitch.sidecar.read import read_sidecar
from tests.damage import damaged
from tests.property.test_camera_file_reading import TEXTS as CAMERA_FILES
from tests.property.test_image_reading import FILES as IMAGES
from tests.property.test_sidecar_reading import GOOD as SIDECAR

_SECONDS = 5  # a read that takes longer hangs
_MEMORY = 6 * 2**30  # bytes; a read that needs more is a bomb
_LARGEST = 2_000_000  # px of an image that is decoded: fields that claim more cost nothing to say


@dataclass(frozen=True)
class Parser:
    """What reads a kind of file, and good files of it."""

    name: str
    good: tuple[bytes, ...]
    read: Callable[[Path], Any]
    file: str = "file"


def _encoded(kind: str, mode: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    samples = np.random.default_rng(5).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    Image.fromarray(samples).convert(mode).save(stream, kind, **options)
    return stream.getvalue()


def _tiff(samples: Any, **options: Any) -> bytes:
    stream = io.BytesIO()
    tifffile.imwrite(stream, samples, **options)
    return stream.getvalue()


def _images() -> tuple[bytes, ...]:
    rng = np.random.default_rng(6)
    deep = rng.integers(0, 65536, (20, 30, 3), dtype=np.uint16)
    return (
        *IMAGES.values(),
        *(_encoded("JPEG", mode, progressive=True) for mode in ("L", "CMYK")),
        *(_encoded("PNG", mode) for mode in ("1", "P", "LA", "RGBA", "I;16")),
        *(_encoded("TIFF", "RGB", compression=name) for name in ("packbits", "tiff_lzw", "jpeg")),
        _tiff(deep, photometric="rgb"),
        _tiff(rng.random((20, 30, 5)).astype(np.float32), planarconfig="separate", photometric="minisblack"),
        _tiff(deep, photometric="rgb", tile=(16, 16), compression="zlib", predictor=True),
        _tiff(deep, photometric="rgb", bigtiff=True, rowsperstrip=3),
        *(_encoded(kind, "RGB") for kind in ("BMP", "GIF", "PPM")),
        _encoded("JPEG2000", "RGB"),
    )


def _image(file: Path) -> Any:
    metadata = read_metadata(file)
    return read_image(file) if metadata.size[0] * metadata.size[1] < _LARGEST else metadata


def _mask(file: Path) -> Any:
    width, height = read_metadata(file).size
    return read_mask(file, (width, height)) if width * height < _LARGEST else None


def _exif_blocks() -> tuple[bytes, ...]:
    """EXIF with every tag that is read, and with the orientation as text and as a float."""
    whole = Image.open(io.BytesIO(IMAGES["jpg"])).getexif().tobytes()
    head = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01"
    text, number = b"\x02\0\x02\0\0\x006\0\0\0", b"\x0b\0\x01\0\0\0\0\0\xc0\x40"
    return (whole, *(head + value + bytes(4) for value in (text, number)))


def _xmp(file: Path) -> Any:
    """The file's content as the XMP block of an image."""
    image = Image.new("L", (40, 30))
    image.info["xmp"] = file.read_bytes()
    return _by_name(file, partial(metadata_of, image))


def _exif(file: Path) -> Any:
    """The file's content as the EXIF block of an image, which is read, and kept for the output."""
    image = file.parent / "a.png"
    Image.new("L", (40, 30)).save(image, exif=file.read_bytes())
    metadata = read_metadata(image)
    write_image(file.parent / "b.png", np.zeros((30, 40), np.uint8), metadata=metadata)
    return read_metadata(file.parent / "b.png")


def _tiles(file: Path) -> Any:
    """The file's lines as the names of files in a folder: is it replaced only if all of them are tiles?"""
    folder = Path(tempfile.mkdtemp(dir=file.parent)) / "a_files"
    folder.mkdir()
    for name in file.read_bytes().splitlines():
        path = Path(os.path.normpath(folder / os.fsdecode(name)))
        if b"\0" in name or not path.is_relative_to(folder) or len(name) > 200:
            continue
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    files = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()]
    if holds_only_tiles(folder) and not all(re.fullmatch(r"[0-9]{1,2}/[0-9]+_[0-9]+\.jpg", name) for name in files):
        raise AssertionError(f"a folder with {files} would be deleted")
    shutil.rmtree(folder.parent)


def _attitudes(file: Path) -> Any:
    sources = [Source(Path(f"{name}.jpg"), Metadata((400, 300)), Camera((400, 300))) for name in "ab"]
    return with_attitudes(sources, file)


def _configuration(file: Path) -> Any:
    return read_config(file, cli.commands, "mosaic")


def _list(file: Path) -> Any:
    # What is named in the list is complained about by that name.
    return _by_name(file, partial(find_images, [f"@{file}"]))


def _by_name(file: Path, read: Callable[[], Any]) -> Any:
    """Read what cannot know or need not say what it is read from."""
    try:
        return read()
    except RdstitchError as error:
        raise type(error)(one_line(f"{file}: {error}")) from error


def is_rdstitch_output(file: Path) -> Any:
    """A folder with one image beside which this file lies as its sidecar."""
    (file.parent / "a.png").write_bytes(IMAGES["png"])
    return find_images([file.parent])


_CONFIGURATIONS = (
    b'[common]\nfeatures = "sift"\nwork-megapixels = 2.5\noverwrite = true\nworkers = 2\n\n[mosaic]\nscale = 0.5\n'
    b'blend = "feather"\ntilt = "1.5,-0.5"\nmax-memory = "800M"\n[trajectory]\nformat = "tum"\nheight = 0.42\n',
    b'[pano]\nlambda = -0.2\nattitude-std = "0.5"\nseed = 0x10\n[apply]\ncrop = true\nmatch = """name"""\n',
)
_TABLES = b"name,psi,theta\na.jpg,1.5,-2\nb.jpg,0,0\n", b'theta,"x",psi,name\r\n1,2,3,"a.jpg"\r\n4,5,6,b.jpg'
_LISTS = b"a.jpg\nb c.jpg\n\n*.png\n@list\n", b"/nowhere/[a]?.tif\r\nx\0y\n"

_XMP_BLOCKS = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:GimbalYawDegree="+31.5" '
    b'drone-dji:GimbalPitchDegree="-89.90"><drone-dji:GimbalRollDegree>+0.25</drone-dji:GimbalRollDegree>'
    b"<drone-dji:CalibratedFocalLength>3666.6</drone-dji:CalibratedFocalLength></rdf:Description></x:xmpmeta>",
    b":CalibratedFocalLength>" * 5000 + b"<Camera:Yaw>1</Camera:Yaw>" * 2000 + b" " * 50_000,
)
_TILE_NAMES = (b"0/0_0.jpg\n1/0_0.jpg\n10/3_2.jpg\n10/12_40.jpg\n", b"0/0_0.jpg\n2023/raw/wedding.nef\nnotes.txt\n")

PARSERS = (
    Parser("sidecar", (json.dumps(SIDECAR).encode(), json.dumps(SIDECAR, indent=2).encode()), read_sidecar),
    Parser("camera file", tuple(text.encode() for text in CAMERA_FILES), load_camera),
    Parser("config file", _CONFIGURATIONS, _configuration),
    Parser("attitude table", _TABLES, _attitudes),
    Parser("list", _LISTS, _list),
    Parser("sidecar beside an image", (json.dumps(SIDECAR).encode(),), is_rdstitch_output, "a.png.json"),
    Parser("image", _images(), _image),
    Parser("xmp", _XMP_BLOCKS, _xmp),
    Parser("exif", _exif_blocks(), _exif),
    Parser("deep zoom folder", _TILE_NAMES, _tiles),
    Parser("mask", tuple(_encoded("PNG", mode) for mode in ("1", "L", "RGBA", "I;16")), _mask),
)


def problem_of(parser: Parser, file: Path) -> str:
    """What is wrong with how a file was received; empty if nothing is."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            parser.read(file)
    except RdstitchError as error:
        named = str(file.parent) in str(error)
        return "" if named and "\n" not in str(error) else f"complains without the name, or in lines: {error}"
    except Exception:  # noqa: BLE001 - whatever it is, it is what is looked for
        return traceback.format_exc()
    return ""


def _fuzz(parser: Parser, seed: int, seconds: float, folder: Path) -> None:
    """Damage files until the time is over or one of them is received badly; the last file stays."""
    signal.signal(signal.SIGALRM, lambda number, frame: sys.exit("hangs"))
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    rng, file = random.Random(f"{parser.name} {seed}"), folder / parser.file
    start, count = time.monotonic(), 0
    while time.monotonic() - start < seconds:
        file.write_bytes(damaged(rng, rng.choice(parser.good), parser.good))
        signal.alarm(_SECONDS)
        problem = problem_of(parser, file)
        signal.alarm(0)
        count += 1
        if problem:
            sys.exit(f"after {count} files: {problem}")
    print(f"{parser.name}: {count} damaged files, nothing wrong", flush=True)


def main() -> None:
    """Fuzz one parser after the other; the status is 1 when one of them stumbled."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0, help="for all parsers together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=[item.name for item in PARSERS])
    parser.add_argument("--keep", type=Path, default=Path(), help="folder for files that something stumbled over")
    wanted = parser.parse_args()
    chosen = [item for item in PARSERS if wanted.only in (None, item.name)]
    failed = 0
    for item in chosen:
        for good in item.good:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / item.file
                file.write_bytes(good)
                if problem := problem_of(item, file):
                    raise SystemExit(f"{item.name}: a good file is not read: {problem}")
        with tempfile.TemporaryDirectory() as folder:
            share = 60.0 * wanted.minutes / len(chosen)
            process = multiprocessing.Process(target=_fuzz, args=(item, wanted.seed, share, Path(folder)))
            process.start()
            process.join()
            if process.exitcode:
                failed += 1
                kept = wanted.keep / f"{item.name.replace(' ', '_')}_{wanted.seed}"
                kept.write_bytes((Path(folder) / item.file).read_bytes())
                print(f"{item.name}: stumbled (status {process.exitcode}); the file is {kept}", flush=True)
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main()
