"""The recipes: each reads as the sequence of its stages."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from rdstitch.camera import FloatArray
from rdstitch.compositing import Composite, compose, plan_canvas
from rdstitch.errors import ArgumentError, PartialResultError, RegistrationError
from rdstitch.io.atomic import check_output, write_json_atomic
from rdstitch.io.read import read_image
from rdstitch.io.write import check_size, write_image
from rdstitch.pipeline.options import StitchOptions
from rdstitch.pipeline.register import Progress, Registration, register, silent
from rdstitch.pipeline.result import StitchResult
from rdstitch.pipeline.sidecar import sidecar
from rdstitch.pipeline.sources import Source, read_sources
from rdstitch.pipeline.verdict import judge
from rdstitch.registration.selection import all_pairs


def pano(
    paths: Iterable[str | Path],
    output: str | Path | None = None,
    options: StitchOptions | None = None,
    *,
    progress: Progress = silent,
) -> StitchResult:
    """Stitch a few pictures that overlap, in any order, in the frame of one of them.

    Parameters
    ----------
    paths : iterable of path
        Two or more pictures.
    output : path, optional
        Picture to write, with the sidecar beside it; without it the picture is in the result.
    options : StitchOptions, optional
    progress : callable
        Called with the name of a stage, the number of steps done, and their total.

    Raises
    ------
    RdstitchError
        See the tree in :mod:`rdstitch.errors`.
    """
    options = options or StitchOptions()
    paths = list(paths)
    _check_outputs(output, options, paths)
    sources = _read(paths, options)
    registration = register(sources, all_pairs(len(sources)), options, skip_bad=False, progress=progress)
    return _finish(registration, _in_frame_of_reference(registration), output, options, progress)


def _check_outputs(output: str | Path | None, options: StitchOptions, inputs: Sequence[str | Path]) -> None:
    """Find out before long work whether everything can be written."""
    if output is not None:
        check_output(output, options.overwrite, inputs)
        check_output(f"{output}.json", options.overwrite, inputs, suffixes=())
    if options.save_camera is not None:
        check_output(options.save_camera, options.overwrite, inputs, suffixes=())


def _read(paths: Sequence[str | Path], options: StitchOptions) -> list[Source]:
    sources, _ = read_sources(
        paths, camera=options.camera, focal=options.focal, distortion=options.distortion, skip_bad=False
    )
    if len(sources) < 2:
        raise ArgumentError("stitching needs two pictures or more; name at least one more")
    return sources


def _in_frame_of_reference(registration: Registration) -> FloatArray:
    """Homographies (N, 3, 3) into the undistorted frame of the reference picture."""
    alignment = registration.alignment
    return np.linalg.inv(alignment.homographies[alignment.reference]) @ alignment.homographies


def _finish(
    registration: Registration,
    homographies: FloatArray,
    output: str | Path | None,
    options: StitchOptions,
    progress: Progress,
) -> StitchResult:
    """Judge, compose, write."""
    verdict = judge(registration, options.threshold)
    if not verdict.ok and not options.force:
        reasons = "; ".join(verdict.failures)
        raise RegistrationError(f"no reliable result: {reasons} (--force writes it all the same)")
    if options.strict and registration.left_out:
        raise PartialResultError("; ".join(f"left out {m.path}: {m.reason}" for m in registration.left_out))
    alignment = replace(registration.alignment, homographies=homographies)
    registration = replace(registration, alignment=alignment)
    used = np.flatnonzero(alignment.used)
    cameras = [alignment.cameras[i] for i in used]
    sources = [registration.sources[i] for i in used]
    canvas = plan_canvas(
        cameras,
        homographies[used],
        scale=options.composite.scale,
        rotate=options.composite.rotate,
        reference=int(np.flatnonzero(used == alignment.reference)[0]),
        names=[source.name for source in sources],
    )
    if output is not None:
        check_size(output, canvas.size)
    composite = compose(
        [partial(read_image, source.path) for source in sources],
        cameras,
        homographies[used],
        canvas,
        options.composite,
        progress=lambda share: progress("compositing", round(100 * share), 100),
    )
    result = StitchResult(registration, composite.canvas, verdict, options, None, composite)
    if output is not None:
        result = replace(result, output=Path(output), composite=None)
        _write(result, composite, sources[0])
    if options.save_camera is not None:
        write_json_atomic(options.save_camera, alignment.cameras[alignment.reference].as_dict())
    return result


def _write(result: StitchResult, composite: Composite, first: Source) -> None:
    """The picture, then the sidecar."""
    output, options = result.output, result.options
    assert output is not None
    write_image(output, composite.pixels, composite.alpha, first.metadata, background=options.composite.background)
    write_json_atomic(f"{output}.json", sidecar(result))
