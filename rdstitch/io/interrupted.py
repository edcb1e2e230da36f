"""Runs that were killed while they published: the picture is in its place, its sidecar still in the hidden folder."""

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from rdstitch.io.deepzoom import tiles_folder
from rdstitch.io.fingerprint import Fingerprint, fingerprint
from rdstitch.records import MAX_FILE
from rdstitch.regular_files import read_limited


def interrupted_outputs(folder: Path) -> frozenset[str]:
    """Names of the pictures in a folder that a staged sidecar describes by size and digest: rdstitch wrote them."""
    with suppress(OSError, ValueError):
        return frozenset(
            picture.name for staging in folder.glob(".rdstitch-*.part") for picture, _ in _staged_sidecars(staging)
        )
    return frozenset()


def publish_sidecars(staging: Path) -> None:
    """From the hidden folder of a dead process, give a published picture the sidecar that it still lacks."""
    for picture, sidecar in _staged_sidecars(staging):
        # A link replaces nothing.
        with suppress(OSError):
            os.link(sidecar, f"{picture}.json")


def _staged_sidecars(staging: Path) -> Iterator[tuple[Path, Path]]:
    """Pictures beside a hidden folder, each with the sidecar in the folder that was written with it."""
    for file in sorted(staging.glob("new*.json")):
        with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):
            if file.is_symlink():
                continue
            record = json.loads(read_limited(file, MAX_FILE))
            output = record["output"]
            picture = staging.parent / Path(output["file"]).name
            # The digest takes long, and can agree only if the size does.
            tiles = tiles_folder(picture) if picture.suffix.lower() == ".dzi" else None
            if record["format"] != "rdstitch sidecar" or (tiles is None and picture.stat().st_size != output["bytes"]):
                continue
            if fingerprint(picture, tiles) == Fingerprint(output["bytes"], output["sha256"]):
                yield picture, file
