"""The recipes: each reads as the sequence of its stages."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.alignment.trajectory import Trajectory
from rdstitch.camera_files import CAMERA_SUFFIXES, save_camera
from rdstitch.errors import ArgumentError, InputError
from rdstitch.export.path_plot import path_as_svg
from rdstitch.inputs.attitudes import with_attitudes
from rdstitch.inputs.find import find_pictures
from rdstitch.inputs.frame import Frame, Images, Named, as_inputs, files_of
from rdstitch.inputs.masks import with_masks
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io.atomic import check_distinct, check_output, write_json_atomic, write_text_atomic
from rdstitch.messages import Message
from rdstitch.options import StitchOptions
from rdstitch.pipeline.accept import accept
from rdstitch.pipeline.compose import compose_pictures
from rdstitch.pipeline.register import in_frame_of_reference, register
from rdstitch.progress import Progress, silent
from rdstitch.registration import Registration
from rdstitch.sidecar.write import sidecar
from rdstitch.stitch_result import StitchResult

Layout = Literal["csv", "tum"]

_MAX_SCALE_UNCERTAINTY = 0.05  # share that lengths may be off by, as far as the focal length is, without a word


def pano(
    inputs: Images,
    output: str | Path | None = None,
    options: StitchOptions | None = None,
    *,
    every: int = 1,
    progress: Progress = silent,
) -> StitchResult:
    """Stitch a few pictures that overlap, in any order, in the frame of one of them.

    Parameters
    ----------
    inputs : path, ndarray, or iterable of them
        Two or more pictures; every one must be readable. What :func:`mosaic` takes.
    output : path, optional
        Picture to write, with the sidecar beside it; without it nothing is written, and the picture is
        ``result.image``.
    options : StitchOptions, optional
    every : int
        Use every n-th video frame.
    progress : callable
        Called with the name of a stage, the number of steps done, and their total.

    Returns
    -------
    StitchResult
        The picture or its file, with everything that was estimated.

    Raises
    ------
    RdstitchError
        See the tree in :mod:`rdstitch.errors`.

    Examples
    --------
    >>> import rdstitch
    >>> result = rdstitch.pano(["left.png", "middle.png"], options=rdstitch.StitchOptions(seed=1))
    >>> result.image.shape[2], result.ok
    (3, True)
    """
    options = options or StitchOptions()
    with _pictures(inputs, output, options, every) as frames:
        _check_outputs(output, options, files_of(frames))
        sources, _ = _read(frames, options, skip_bad=False)
        registration = register(sources, options, skip_bad=False, progress=progress)
        registration = in_frame_of_reference(registration)
        return _composite(registration, output, options, progress)


def mosaic(
    inputs: Images,
    output: str | Path | None = None,
    options: StitchOptions | None = None,
    *,
    every: int = 1,
    progress: Progress = silent,
) -> StitchResult:
    """Stitch a whole sequence on the rectified plane: seen straight from above, metric up to scale.

    Parameters
    ----------
    inputs : path, ndarray, or iterable of them
        Folders, pictures, patterns, ``@list`` files, videos, and arrays of shape (H, W) or (H, W, C), whose channels
        are in the order of ``options.channel_order``; see :func:`rdstitch.inputs.frame.as_inputs`. Pictures that cannot
        be read are left out by name.
    output : path, optional
        As for :func:`pano`.
    options : StitchOptions, optional
    every : int
        Use every n-th video frame.
    progress : callable

    Returns
    -------
    StitchResult
        The picture or its file, with everything that was estimated.

    Raises
    ------
    RdstitchError
        See the tree in :mod:`rdstitch.errors`.

    Examples
    --------
    >>> import rdstitch
    >>> small = rdstitch.CompositeOptions(scale=0.5)
    >>> result = rdstitch.mosaic(["flight/"], "small.tif", rdstitch.StitchOptions(composite=small))
    >>> result.output.name, result.registration.alignment.used.all()
    ('small.tif', np.True_)
    """
    options = options or StitchOptions()
    with _pictures(inputs, output, options, every) as frames:
        _check_outputs(output, options, files_of(frames))
        registration = _register_all(frames, options, progress)
        return _composite(registration, output, options, progress)


def calibrate(
    inputs: Images, options: StitchOptions | None = None, *, every: int = 1, progress: Progress = silent
) -> Registration:
    """Find the lens from pictures of a plane; the camera is ``result.camera``.

    Parameters
    ----------
    inputs, options, every, progress
        As for :func:`mosaic`; nothing is composited. ``options.save_camera`` names the file to write.

    Returns
    -------
    Registration
        With the cameras and poses in ``alignment``.

    Raises
    ------
    RdstitchError
        See the tree in :mod:`rdstitch.errors`.
    """
    options = options or StitchOptions()
    with _pictures(inputs, None, options, every) as frames:
        _check_outputs(None, options, files_of(frames))
        registration = _register_all(frames, options, progress)
        registration = accept(registration, options, lens_only=True)
    _release_decoded_images(registration)
    _save_camera(registration, options)
    return registration


def trajectory(
    inputs: Images,
    output: str | Path | None = None,
    options: StitchOptions | None = None,
    *,
    layout: Layout = "csv",
    plot: str | Path | None = None,
    height: float = 1.0,
    every: int = 1,
    progress: Progress = silent,
) -> tuple[Trajectory, Registration]:
    """Find the path of the camera over the plane.

    Parameters
    ----------
    inputs, options, every, progress
        As for :func:`mosaic`.
    output : path, optional
        File to write.
    layout : str
        "csv" or "tum".
    plot : path, optional
        SVG file to draw the path to.
    height : float
        Height of the first frame above the plane, in the unit that positions shall have.

    Returns
    -------
    Trajectory, Registration
        The path, and the registration that it comes from.
    """
    options = options or StitchOptions()
    with _pictures(inputs, None, options, every) as frames:
        files = [file for file in (output, plot) if file is not None]
        for file in files:
            check_output(file, options.overwrite, files_of(frames), suffixes=())
        check_distinct(files)
        registration = _register_all(frames, options, progress, metric=True)
        registration = accept(registration, options)
    _release_decoded_images(registration)
    registration = registration.with_messages(_scale_uncertainty(registration.alignment))
    path = Trajectory.from_alignment(registration.alignment, height)
    if output is not None:
        write_text_atomic(output, path.as_csv() if layout == "csv" else path.as_tum())
    if plot is not None:
        write_text_atomic(plot, path_as_svg(path))
    return path, registration


@contextmanager
def _pictures(inputs: Images, output: str | Path | None, options: StitchOptions, every: int) -> Iterator[list[Frame]]:
    """The frames that the inputs stand for; those of videos exist only inside the block."""
    given, exclude = as_inputs(inputs, options.channel_order), [] if output is None else [output]
    with TemporaryDirectory(prefix="rdstitch-") as folder:
        yield find_pictures(given, exclude=exclude, frames_folder=Path(folder), every=every)


def _register_all(
    frames: Sequence[Frame], options: StitchOptions, progress: Progress, *, metric: bool = False
) -> Registration:
    """Register a sequence, leaving out what cannot be read."""
    sources, unread = _read(frames, options, skip_bad=True)
    registration = register(sources, options, skip_bad=True, metric=metric, progress=progress)
    return registration.with_messages(unread)


def _check_outputs(output: str | Path | None, options: StitchOptions, inputs: Sequence[str | Path]) -> None:
    """Find out before long work whether everything can be written."""
    if output is not None:
        check_output(output, options.overwrite, inputs)
        check_output(f"{output}.json", options.overwrite, inputs, suffixes=())
    if options.save_camera is not None:
        check_output(options.save_camera, options.overwrite, inputs, suffixes=CAMERA_SUFFIXES)
        check_distinct([options.save_camera, *([] if output is None else [f"{output}.json"])])


def _read(inputs: Sequence[Named], options: StitchOptions, *, skip_bad: bool) -> tuple[list[Source], list[Message]]:
    sources, unread = read_sources(
        inputs, camera=options.camera, focal=options.focal, distortion=options.distortion, skip_bad=skip_bad
    )
    if len(sources) < 2:
        if unread:
            raise InputError(f"fewer than two pictures can be read; {unread[0].text}")
        raise ArgumentError("stitching needs two different pictures or more; name at least one more")
    return with_attitudes(with_masks(sources, options.mask), options.attitude), unread


def _composite(
    registration: Registration, output: str | Path | None, options: StitchOptions, progress: Progress
) -> StitchResult:
    """Judge, compose into the file or into memory, write the sidecar."""
    registration = accept(registration, options)
    alignment = registration.alignment
    used = np.flatnonzero(alignment.used)
    sources = [registration.sources[i] for i in used]
    composed = compose_pictures(
        sources,
        [alignment.cameras[i] for i in used],
        alignment.homographies[used],
        int(np.flatnonzero(used == alignment.reference)[0]),
        output,
        options.composite,
        options.threads,
        progress,
        overwrite=options.overwrite,
        dry_run=options.dry_run,
        turned=alignment.on_sphere,
    )
    _release_decoded_images(registration)
    result = StitchResult(
        registration.with_messages(map(Message, composed.notes)),
        composed.canvas,
        options,
        None if output is None else Path(output),
        composed.composite,
        composed.plan,
    )
    if options.dry_run:
        return result
    if output is not None:
        write_json_atomic(f"{output}.json", sidecar(result))
    _save_camera(registration, options)
    return result


def _release_decoded_images(registration: Registration) -> None:
    """Let go of pictures that were kept for stages that will not come."""
    for source in registration.sources:
        source.decoded_images.clear()


def _scale_uncertainty(alignment: Alignment) -> list[Message]:
    """A warning where the focal length, and with it the length of every step, is hardly known."""
    unsure = 0.0 if alignment.focal is None or alignment.focal_std is None else alignment.focal_std / alignment.focal
    if unsure <= _MAX_SCALE_UNCERTAINTY:
        return []
    return [
        Message(
            f"all lengths may be off together by {unsure:.0%}: the pictures hardly show the focal length; give --focal"
        )
    ]


def _save_camera(registration: Registration, options: StitchOptions) -> None:
    if options.save_camera is not None:
        save_camera(registration.camera, options.save_camera)
