"""Size and digest of an image's files, by which a sidecar recognises its image."""

import hashlib
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Fingerprint:
    """Size and digest of an image's files."""

    size: int  # bytes of all files
    # of the file; of a Deep Zoom image that of the list of its files, as ``sha256sum`` prints it (digest, two spaces,
    # name), in order of names, the description first as ``.dzi``; of an OME-Zarr image the same of all its files
    sha256: str


def fingerprint(image: Path, tiles: Path | None = None) -> Fingerprint:
    """The fingerprint of an image, and of the tiles that belong to it."""
    if image.is_dir():
        tiles, named = image, []
    elif tiles is None:
        return Fingerprint(image.stat().st_size, _sha256(image))
    else:
        named = [(".dzi", image)]
    members = sorted(path for path in tiles.rglob("*") if path.is_file())
    files = [*named, *((file.relative_to(tiles).as_posix(), file) for file in members)]
    listing = "".join(f"{_sha256(file)}  {name}\n" for name, file in files)
    return Fingerprint(sum(file.stat().st_size for _, file in files), hashlib.sha256(listing.encode()).hexdigest())


def _sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
