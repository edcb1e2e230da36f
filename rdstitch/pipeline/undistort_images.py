"""Undistorting single images with a known lens."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.choices import Framing, ImageFormat
from rdstitch.compositing import Canvas, Composite, CompositeOptions, PlacedImage, compose
from rdstitch.compositing.canvas import refuse_scale
from rdstitch.errors import ArgumentError, OutputError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.find import found_images
from rdstitch.inputs.frame import Images, as_inputs, to_channel_order
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io.write import write_image
from rdstitch.options.option import options_of, with_fields
from rdstitch.options.undistort_options import UndistortOptions
from rdstitch.pipeline.inputs.camera_and_odometry import read_camera
from rdstitch.results.messages import Message, ignored
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.output_checks import WRITABLE_SUFFIXES, check_outputs
from rdstitch.system.outputs import Outputs, file_name
from rdstitch.system.progress import Progress, silent

_POINTS_PER_SIDE = 256


@overload
def undistort(
    inputs: Images, folder: str | Path, options: UndistortOptions | None = None, **more: Any
) -> list[Path]: ...
@overload
def undistort(
    inputs: Images, folder: None = None, options: UndistortOptions | None = None, **more: Any
) -> list[NDArray[Any]]: ...
@one_native_thread()
def undistort(
    inputs: Images,
    folder: str | Path | None = None,
    options: UndistortOptions | None = None,
    *,
    warn: Callable[[Message], None] = ignored,
    progress: Progress = silent,
    **fields: Any,
) -> list[Path] | list[NDArray[Any]]:
    """Undistort images, each into a file of the same name in a folder, or into an array.

    Parameters
    ----------
    inputs : path, ndarray, or iterable of them
        Whatever :func:`rdstitch.mosaic` takes; every image must be readable, or none is written. An array becomes the
        PNG file ``image_000i.png``, or TIFF where its samples need that.
    folder : path, optional
        Made if it does not exist. Without it, nothing is written.
    options : UndistortOptions, optional
    warn : callable
        Called with each thing that the user should know: images not taken as input, and damaged ones.
    progress : callable
    **fields
        Fields of the options, instead of those in ``options``: ``undistort(images, distortion=-0.2, view="all")``.

    Returns
    -------
    list of Path, or of ndarray
        The files written; without a folder the images, (H, W) or (H, W, C), 0 where there is nothing to show.
    """
    options = with_fields(options_of(UndistortOptions, options), fields)
    if (options.camera is None) == (options.distortion is None):
        raise ArgumentError("give either a camera or a distortion")
    given, guard, files, images = as_inputs(inputs, options.channel_order), InputGuard(), list[Path](), []
    camera, notes = (None, []) if options.camera is None else read_camera(options.camera, given)
    with (
        found_images(given, every=1, topic=options.topic) as listed,
        Outputs(options.overwrite) as outputs,
    ):
        sources, _ = read_sources(
            listed.frames, camera=camera, distortion=options.distortion, skip_bad=False, guard=guard
        )
        for message in (*notes, *listed.messages):
            warn(message)
        if folder is not None:
            files = _files(sources, Path(folder), options.image_format)
            outputs.make_folder(Path(folder))
            check_outputs(files, options.overwrite, [*listed.files, *options.files])
        for index, source in enumerate(sources):
            image = _undistorted(source, options.view)
            if folder is None:
                images.append(to_channel_order(image.pixels, options.channel_order))
            else:
                metadata = source.metadata if options.view == "same" else source.metadata.in_another_size()
                write_image(files[index], image.pixels, image.alpha, metadata=metadata, outputs=outputs)
            progress("undistorting", index + 1, len(sources))
    for message in guard.messages:
        warn(message)
    return images if folder is None else files


def _undistorted(source: Source, view: Framing) -> Composite:
    plain = CompositeOptions(exposure="none", seam="none", blend="none")
    canvas = undistorted_canvas(source.camera, view)
    return compose([PlacedImage(source.read, source.camera, np.eye(3))], canvas, plain)


def _files(sources: Sequence[Source], folder: Path, image_format: ImageFormat | None) -> list[Path]:
    """The files to write; two of one name are refused."""
    files = [folder / _output_name(source, image_format) for source in sources]
    twice = [path for path, count in Counter(files).items() if count > 1]
    if twice:
        raise OutputError(f"{min(twice)}: two of the images have this name; undistort them into different folders")
    return files


def _output_name(source: Source, image_format: ImageFormat | None) -> str:
    in_memory = source.frame is not None and source.frame.image is not None
    if image_format is None and not in_memory and source.path.suffix.lower() in WRITABLE_SUFFIXES:
        return file_name(source.name)
    stem = source.name if in_memory else Path(file_name(source.name)).stem
    return f"{stem}.{image_format or ('png' if _fits_png(source) else 'tif')}"


def _fits_png(source: Source) -> bool:
    """Whether PNG holds the samples; it holds those of all files that cannot be written in their own format."""
    if source.frame is None or source.frame.image is None:
        return True
    pixels = source.frame.decoded().pixels
    return pixels.dtype != np.float32 and (pixels.ndim == 2 or pixels.shape[2] == 3)


def undistorted_canvas(camera: Camera, view: Framing) -> Canvas:
    """The canvas of an undistorted image, at its scale at the distortion centre."""
    outline = camera.undistort(camera.outline(_POINTS_PER_SIDE))
    if view == "same":
        low, high = np.full(2, -0.5), np.array(camera.image_size) - 0.5
    elif view == "all":
        low, high = outline.min(axis=0), outline.max(axis=0)
    else:
        low, high = _inner_rectangle(outline, camera)
    size = np.maximum(np.floor(high - low + 1e-6), 1)
    refuse_scale([camera], size, 'choose the view "same" or "valid"')
    shift = -(low + 0.5)
    matrix = np.eye(3)
    matrix[:2, :2] *= camera.scale
    matrix[:2, 2] = np.array(camera.center) + shift
    return Canvas((int(size[0]), int(size[1])), matrix, (outline + shift,))


def _inner_rectangle(outline: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Largest of the rectangles of the image's aspect ratio within the undistorted outline, about the centre."""
    half = np.array(camera.image_size) / 2.0
    middle = (np.array(camera.image_size) - 1.0) / 2.0
    # A rectangle reaches an outline point where the larger of its relative coordinates is the scale.
    scale = float(np.abs((outline - middle) / half).max(axis=1).min())
    return middle - scale * half, middle + scale * half
