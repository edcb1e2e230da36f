"""All bands of a rig of cameras: the first is registered, the lenses of the others to it, and all have one grid."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

from rdstitch.errors import ArgumentError
from rdstitch.inputs.find import found_images
from rdstitch.inputs.frame import Frame, Images, as_inputs
from rdstitch.inputs.selection import selected
from rdstitch.options.files_beside import NOTHING_BESIDE, FilesBeside
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.apply_sidecar import Recomposition, apply
from rdstitch.pipeline.recipes import mosaic
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.outputs import check_outputs
from rdstitch.system.progress import Progress, silent


def mosaic_bands(
    inputs: Images,
    output: str | Path,
    bands: Mapping[str, str],
    options: StitchOptions | None = None,
    *,
    every: int | None = None,
    progress: Progress = silent,
    beside: FilesBeside = NOTHING_BESIDE,
) -> tuple[StitchResult, tuple[Recomposition, ...]]:
    """Stitch the images of several bands, each band into a file of its own, all on the same pixels.

    Parameters
    ----------
    inputs, options, every, progress, beside
        As for :func:`rdstitch.mosaic`; ``beside`` is for the first band.
    output : path
        ``field.tif`` is written as ``field-NIR.tif`` and so on.
    bands : mapping of str to str
        Names of the bands, and patterns of the names of their images; the first band is registered.

    Returns
    -------
    StitchResult, tuple of Recomposition
        The first band, and the others, each by its own lens; see :func:`rdstitch.pipeline.apply_sidecar.apply`.
    """
    options, file = options or StitchOptions(), Path(output)
    files = [file.with_name(f"{file.stem}-{name}{file.suffix}") for name in bands]
    with found_images(as_inputs(inputs, options.channel_order), every=every, topic=options.topic) as listed:
        check_outputs(files, options.overwrite, listed.files)
        frames = selected(listed.frames, options.exclude, options.include_only)
        chosen = [_of_band(frames, pattern) for pattern in bands.values()]
        options = replace(options, exclude=(), include_only=())
        first = mosaic(chosen[0], files[0], options, progress=progress, beside=beside)
        others = tuple(
            apply(
                f"{files[0]}.json",
                band,
                name,
                mask=options.mask,
                overwrite=options.overwrite,
                workers=options.workers,
                strict=options.strict,
                progress=progress,
            )
            for band, name in zip(chosen[1:], files[1:], strict=True)
        )
    return first, others


def _of_band(frames: Sequence[Frame], pattern: str) -> list[Frame]:
    chosen = [frame for frame in frames if fnmatchcase(frame.path.name.lower(), pattern.lower())]
    if not chosen:
        raise ArgumentError(f"bands: no image has a name like {pattern}")
    return chosen
