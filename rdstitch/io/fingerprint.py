"""Size and digest of a written image: by them a sidecar says what it belongs to, even after a run was killed."""

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rdstitch.file_access import read_limited
from rdstitch.io.deepzoom import tiles_folder
from rdstitch.records import MAX_FILE


@dataclass(frozen=True)
class Fingerprint:
    """What an image's files come to.

    Attributes
    ----------
    size : int
        Bytes of all files.
    sha256 : str
        Of the file; of a Deep Zoom image that of the list of its files, as ``sha256sum`` prints it (digest, two
        spaces, name), in order of names, the description first as ``.dzi``.
    """

    size: int
    sha256: str


def fingerprint(image: Path, tiles: Path | None = None) -> Fingerprint:
    """The fingerprint of an image, and of the tiles that belong to it.

    Raises
    ------
    OSError
        When a file cannot be read.
    """
    if tiles is None:
        return Fingerprint(image.stat().st_size, _sha256(image))
    found = sorted(path for path in tiles.rglob("*") if path.is_file())
    files = [(".dzi", image), *((file.relative_to(tiles).as_posix(), file) for file in found)]
    listing = "".join(f"{_sha256(file)}  {name}\n" for name, file in files)
    return Fingerprint(sum(file.stat().st_size for _, file in files), hashlib.sha256(listing.encode()).hexdigest())


def _sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def interrupted_outputs(folder: Path) -> frozenset[str]:
    """Names of the images in a folder that a staged sidecar describes by size and digest: rdstitch wrote them.

    Their run was killed while it published: the image is in its place, its sidecar still in the hidden folder.
    """
    with suppress(OSError, ValueError):
        return frozenset(
            image.name for staging in folder.glob(".rdstitch-*.part") for image, _ in _staged_sidecars(staging)
        )
    return frozenset()


def publish_sidecars(staging: Path) -> None:
    """From the hidden folder of a dead process, give a published image the sidecar that it still lacks."""
    for image, sidecar in _staged_sidecars(staging):
        # A link replaces nothing.
        with suppress(OSError):
            os.link(sidecar, f"{image}.json")


def _staged_sidecars(staging: Path) -> Iterator[tuple[Path, Path]]:
    """Images beside a hidden folder, each with the sidecar in the folder that was written with it."""
    for file in sorted(staging.glob("new*.json")):
        with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):
            if file.is_symlink():
                continue
            record = json.loads(read_limited(file, MAX_FILE))
            output = record["output"]
            image = staging.parent / Path(output["file"]).name
            # The digest takes long, and can agree only if the size does.
            tiles = tiles_folder(image) if image.suffix.lower() == ".dzi" else None
            if record["format"] != "rdstitch sidecar" or (tiles is None and image.stat().st_size != output["bytes"]):
                continue
            if fingerprint(image, tiles) == Fingerprint(output["bytes"], output["sha256"]):
                yield image, file
