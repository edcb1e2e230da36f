"""The recipes: each reads as the sequence of its stages."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

from rdstitch.choices import Purpose, TrajectoryFormat, TrajectoryFrame
from rdstitch.errors import RegistrationError
from rdstitch.export.trajectory_files import format_of, has_times, path_as_svg, write_trajectory
from rdstitch.inputs.find import FoundImages
from rdstitch.inputs.frame import Images, frame_numbers
from rdstitch.inputs.odometry import as_odometry
from rdstitch.inputs.selection import selected
from rdstitch.inputs.source import Source
from rdstitch.inputs.times import with_times
from rdstitch.options.files_beside import NOTHING_BESIDE, FilesBeside, ReportFile
from rdstitch.options.option import check_parameter
from rdstitch.options.shared_options import Height
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.camera_path import camera_path
from rdstitch.pipeline.composition.choose_layout import choose_layout
from rdstitch.pipeline.composition.compose import compose_images
from rdstitch.pipeline.composition.lay_out import RegistrationLayout
from rdstitch.pipeline.composition.map_canvas import check_map
from rdstitch.pipeline.inputs.read_inputs import in_order, read_inputs
from rdstitch.pipeline.outputs.output_files import OutputFiles, report_refused, save_camera, stage_report
from rdstitch.pipeline.outputs.viewer_pages import viewed_images, write_page
from rdstitch.pipeline.registration.accept import accept
from rdstitch.pipeline.registration.realign import aligner_of, with_reference_of
from rdstitch.pipeline.registration.register import register
from rdstitch.pipeline.registration.working_size import at_full_size
from rdstitch.pipeline.run import RecipeInput, Run
from rdstitch.pipeline.run_on_sources import blocks_on
from rdstitch.results.messages import Message, merge_by_reason, of_severity
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.outputs import json_bytes, text_bytes
from rdstitch.system.progress import Progress, silent
from rdstitch.trajectories.trajectory import Trajectory
from rdstitch.verification.verdict import RefusedError

_NO_TIMES = Message(
    "not every image has a time stamp: numbers of frames stand for them; give --timestamps", code="no-time-stamps"
)


@one_native_thread()
def pano(
    inputs: Images,
    output: str | Path | None = None,
    options: StitchOptions | None = None,
    *,
    every: int | None = None,
    progress: Progress = silent,
    beside: FilesBeside = NOTHING_BESIDE,
) -> StitchResult:
    """Stitch a few images that overlap, in any order, in the frame of one of them.

    Parameters
    ----------
    inputs : path, ndarray, or iterable of them
        Two or more images; every one must be readable. What :func:`mosaic` takes.
    output : path, optional
        Image to write, with the sidecar beside it; without it nothing is written, and the image is
        ``result.image``.
    options : StitchOptions, optional
    every : int, optional
        Use every n-th frame of videos and ROS bags; without it those that show new ground.
    progress : callable
        Called with the name of a stage, the number of steps done, and their total.
    beside : FilesBeside
        What else is written.

    Returns
    -------
    StitchResult
        The image or its file, with everything that was estimated.

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
    return _stitch(RecipeInput.of(inputs, options, Purpose.PANO, every), output, beside, progress)


@one_native_thread()
def mosaic(
    inputs: Images,
    output: str | Path | None = None,
    options: StitchOptions | None = None,
    *,
    every: int | None = None,
    progress: Progress = silent,
    beside: FilesBeside = NOTHING_BESIDE,
) -> StitchResult:
    """Stitch a whole sequence on the rectified plane: seen straight from above, metric up to scale.

    Parameters
    ----------
    inputs : path, ndarray, or iterable of them
        Folders, images, patterns, ``@list`` files, videos, and arrays of shape (H, W) or (H, W, C), whose channels
        are in the order of ``options.channel_order``; see :func:`rdstitch.inputs.frame.as_inputs`. Images that cannot
        be read are left out by name.
    output, options, every, progress, beside
        As for :func:`pano`.

    Returns
    -------
    StitchResult
        As of :func:`pano`, and so is what is raised.

    Examples
    --------
    >>> import rdstitch
    >>> small = rdstitch.CompositeOptions(scale=0.5)
    >>> result = rdstitch.mosaic(["flight/"], "small.tif", rdstitch.StitchOptions(composite=small))
    >>> result.output.name, result.registration.alignment.used.all()
    ('small.tif', np.True_)
    """
    return _stitch(RecipeInput.of(inputs, options, Purpose.MOSAIC, every), output, beside, progress)


def _stitch(given: RecipeInput, output: str | Path | None, beside: FilesBeside, progress: Progress) -> StitchResult:
    run = Run.of(given, output, beside, progress)
    with given.find_images(run.output) as images, run.outputs:
        return stitch_images(images, run)


def stitch_images(
    images: FoundImages, run: Run, *, more_images: Sequence[Path] = (), more_files: Sequence[Path] = ()
) -> StitchResult:
    """Stitch images into the output of a run; ``more_images`` and ``more_files`` may be written after it."""
    options = run.options
    frames = in_order(with_times(images.frames, options.timestamps))
    names = [frame.name for frame in selected(frames, options.exclude, options.include_only)]
    files = OutputFiles.of_images(run, images.files, names, more_images, more_files)
    files.check()
    sources, of_inputs = read_inputs(frames, options, run.guard, skip_bad=run.purpose is not Purpose.PANO)
    files.check_places(sources)
    check_map(sources, options.composite)
    with run.executor(len(sources)) as executor:
        with _failures_explained(run, of_inputs):
            accepted, run = _register_and_check(sources, [*of_inputs, *images.messages], run, executor)
            run.progress("laying out", 0, 1)
            chosen = choose_layout(accepted, run.options, aligner_of(accepted, run))
        return compose_registration(chosen, run, files, executor)


@one_native_thread()
def calibrate(
    inputs: Images,
    options: StitchOptions | None = None,
    *,
    every: int | None = None,
    progress: Progress = silent,
    beside: ReportFile = NOTHING_BESIDE,
) -> Registration:
    """Find the lens from images of a plane; the camera is ``result.camera``.

    Parameters
    ----------
    inputs, options, every, progress
        As for :func:`mosaic`; nothing is composited. ``options.save_camera`` names the file to write.
    beside : FilesBeside
        What else is written: a report.

    Returns
    -------
    Registration
        With the cameras and poses in ``alignment``.
    """
    files = FilesBeside.of(ReportFile, beside, "calibrate")
    given = RecipeInput.of(inputs, options, Purpose.CALIBRATE, every)
    run = Run.of(given, beside=files, progress=progress)
    with given.find_images() as images, run.outputs:
        OutputFiles.of_images(run, images.files).check()
        result = _register_at_full_size(images, run)
        save_camera(result, run)
        return result.with_messages(stage_report(run, result))


@one_native_thread()
def trajectory(
    inputs: Images,
    output: str | Path | None = None,
    options: StitchOptions | None = None,
    *,
    file_format: TrajectoryFormat = "auto",
    plot: str | Path | None = None,
    height: float | None = None,
    frame: TrajectoryFrame | None = None,
    every: int | None = 1,
    progress: Progress = silent,
) -> tuple[Trajectory, Registration]:
    """Find the path of the camera over the plane.

    Parameters
    ----------
    inputs, options, every, progress
        As for :func:`mosaic`, but that every frame of a video is used unless ``every`` says otherwise.
    output : path, optional
        File to write.
    file_format : str
        "csv", "tum", "kitti" or "bag", see :mod:`rdstitch.export.trajectory_files`; "auto": by the suffix of the
        output, otherwise "csv".
    plot : path, optional
        SVG file to draw the path to.
    height : float, optional
        Height of the first frame above the plane, metres; positions are in metres then, and in heights without it.
    frame : str, optional
        "enu", "ros" or "camera": the axes of the file, see :mod:`rdstitch.geometry.path_frames`. "enu" if not given,
        but for "kitti", whose axes are the camera's, and for "bag", whose axes are those of ROS.

    Returns
    -------
    Trajectory, Registration
        The path, and the registration that it comes from.
    """
    for name, kind, value in (("file_format", TrajectoryFormat, file_format), ("height", Height, height)):
        check_parameter(name, kind, value)
    check_parameter("frame", TrajectoryFrame | None, frame)
    file_format = format_of(output, file_format)
    given = RecipeInput.of(inputs, options, Purpose.TRAJECTORY, every)
    run = Run.of(given, progress=progress)
    with given.find_images() as images, run.outputs:
        OutputFiles.of_path(run, images.files, output, plot, file_format).check()
        odometry = as_odometry(run.options.odometry)
        numbers = frame_numbers(images.frames)
        numbered = [replace(frame, number=k) for frame, k in zip(images.frames, numbers, strict=True)]
        registration = _register_at_full_size(replace(images, frames=numbered), run)
        path, messages = camera_path(registration, odometry, height)
        if file_format in ("tum", "bag") and not has_times(path):
            messages.append(_NO_TIMES)
        if output is not None:
            write_trajectory(path, Path(output), file_format, frame, run.outputs)
        save_camera(registration, run)
        if plot is not None:
            drawn = text_bytes(path_as_svg(path, "heights" if height is None else "m"))
            messages += run.outputs.attempt(plot, partial(run.outputs.write, plot, drawn))
        return path, registration.with_messages(messages)


def _register_at_full_size(images: FoundImages, run: Run) -> Registration:
    """Register images, in pixels of their full size."""
    frames = with_times(images.frames, run.options.timestamps)
    sources, of_inputs = read_inputs(frames, run.options, run.guard, skip_bad=True)
    with run.executor(len(sources)) as executor, _failures_explained(run, of_inputs):
        accepted, _ = _register_and_check(sources, [*of_inputs, *images.messages], run, executor)
    return _release_images(at_full_size(accepted), run)


@contextmanager
def _failures_explained(run: Run, of_inputs: Sequence[Message]) -> Iterator[None]:
    """Add unreadable and damaged images to the text of a failure in the block; write the report of a refused result."""
    try:
        yield
    except RegistrationError as error:
        left_out = of_severity(of_inputs, "left out")
        reasons = [str(replace(message, code="")) for message in merge_by_reason([*left_out, *run.guard.warnings])]
        error.args = ("; ".join([str(error), *reasons]),)
        if isinstance(error, RefusedError):
            report_refused(run, error.registration)
        raise


def _register_and_check(
    sources: Sequence[Source], known: Sequence[Message], run: Run, executor: Executor
) -> tuple[Registration, Run]:
    """Register and check, in pixels of the working size; and the run, whose reference image is now known.

    If it shall be the first image, it is the first of those used.
    """
    if run.beside.frame == "first":
        run = run.with_reference(sources[0])
    registration = register(sources, run, executor).with_messages(known)
    run.progress("checking", 0, 1)
    accepted = accept(registration, run)
    first = accepted.alignment.used.tolist().index(True)
    if run.beside.frame == "first" and accepted.alignment.reference != first:
        run = run.with_reference(accepted.sources[first])
        accepted = accept(with_reference_of(registration, aligner_of(registration, run)), run)
    return accepted, run


def compose_registration(chosen: RegistrationLayout, run: Run, files: OutputFiles, executor: Executor) -> StitchResult:
    """Compose the layout of a registration and stage all files that belong to the output."""
    registration, options, outputs = chosen.registration, run.options, run.outputs
    run_blocks = blocks_on(executor, chosen.layout.placed.sources, run.guard, run.cache)
    composed, messages = compose_images(chosen.layout, run, run_blocks)
    result = StitchResult(
        registration=_release_images(registration, run).with_messages((*chosen.messages, *messages)),
        local_alignment=chosen.local,
        **composed.fields | {"options": options.for_images(len(registration.sources))},
    )
    if options.dry_run:
        return result
    result = result.with_messages(write_page(result, outputs, partial(viewed_images, result)))
    result = files.stage(result)
    if run.output is not None:
        # Last: whoever finds it finds what it belongs to.
        from rdstitch.sidecar.write import sidecar  # and with it the forms of camera files, which no picture needs

        outputs.write(f"{run.output}.json", json_bytes(sidecar(result)))
    return result


def _release_images(registration: Registration, run: Run) -> Registration:
    """Release decoded images, and add messages on damaged files."""
    for source in registration.sources:
        source.decoded_images.clear()
    return registration.with_messages(run.guard.messages)
