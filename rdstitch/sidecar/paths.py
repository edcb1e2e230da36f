"""How a sidecar names files: from the folder of its image on."""

import os
from pathlib import Path


def recorded_path(path: Path, output: Path | None) -> str:
    """A file as the sidecar of an output has it, from its folder on; an absolute name, or what is no file, as it is."""
    return rebased_path(path, Path(), output) if path.exists() else str(path)


def rebased_path(path: Path, folder: Path, output: Path | None) -> str:
    """A path from a folder on, as one from the folder of an output on; an absolute one as it is."""
    if output is None or path.is_absolute():
        return str(folder / path)
    named, target = (folder / path.parent).resolve() / path.name, output.parent.resolve()
    return str(named) if named.drive != target.drive else Path(os.path.relpath(named, target)).as_posix()
