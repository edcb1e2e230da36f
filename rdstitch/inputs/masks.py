"""Masks of the user: which part of each image is used."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from rdstitch.errors import InputError
from rdstitch.inputs.image_folders import READABLE_SUFFIXES
from rdstitch.inputs.source import Source
from rdstitch.io.mask import Mask, mask_frame
from rdstitch.system.file_access import canonical_name


def with_masks(sources: Sequence[Source], masks: str | Path | None, *, all_known: bool = True) -> list[Source]:
    """The sources, each with its mask, if it has one.

    ``masks`` is an image: the mask of all images, such as of a camera that sees its own vehicle. Or a folder with a
    mask for each image, or for some, of the image's name; the suffix may differ. One of them at least must have one,
    unless more images are to come.
    """
    if masks is None:
        return list(sources)
    path = Path(masks)
    several = path.is_dir()
    by_stem = (
        _by_stem(path) if several else dict.fromkeys((canonical_name(source.path.stem) for source in sources), path)
    )
    masked = []
    for source in sources:
        stem = canonical_name(source.path.stem)
        # Of images of one name in several folders, each may have its own in a folder of that name.
        file, mask = by_stem.get(str(PurePosixPath(source.name).with_suffix("")), by_stem.get(stem)), None
        if file is not None:
            if file.resolve() == source.path.resolve():
                raise InputError(f"{file}: is the image itself, not its mask; masks lie in another folder")
            metadata = source.metadata
            frame = mask_frame(file, source.path, metadata.size, metadata.orientation, of_camera=not several)
            mask = Mask(file, frame)
        masked.append(replace(source, mask=mask))
    if sources and all_known and all(source.mask is None for source in masked):
        raise InputError(f"{path}: none of the masks has the name of an image, such as {sources[0].path.stem}.png")
    return masked


def _by_stem(folder: Path) -> Mapping[str, Path]:

    def refuse(error: OSError) -> None:
        raise InputError(f"{folder}: cannot read the folder: {error.strerror}") from error

    named = (Path(parent, name) for parent, _, names in os.walk(folder, onerror=refuse) for name in names)
    files = sorted(path for path in named if path.suffix.lower() in READABLE_SUFFIXES)
    masks: dict[str, Path] = {}
    for path in files:
        other = masks.setdefault(canonical_name(path.relative_to(folder).with_suffix("").as_posix()), path)
        if other != path:
            raise InputError(f"{path}: {other.name} is a mask for the same image; remove one of them")
    return masks
