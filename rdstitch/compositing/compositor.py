"""The compositor: pictures, cameras and homographies in, one picture out, in memory or in a file."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.camera import Camera
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.options import CompositeOptions
from rdstitch.compositing.photo_sphere import photo_sphere_xmp
from rdstitch.compositing.photometric import Exposure
from rdstitch.compositing.preparation import OutputStrip, ShareProgress, prepare_composite
from rdstitch.compositing.seam_finder import SeamMap
from rdstitch.compositing.source_images import PictureLoader, Preview
from rdstitch.compositing.warp import Displacement
from rdstitch.io.fingerprint import Fingerprint
from rdstitch.io.layout import Layout
from rdstitch.io.metadata import Metadata
from rdstitch.io.outputs import Outputs
from rdstitch.io.tiff import ExtraTag
from rdstitch.io.write import check_format, check_memory, write_strips


@dataclass(frozen=True, repr=False)
class Composite:
    """The stitched picture.

    Attributes
    ----------
    pixels : ndarray of shape (H, W) or (H, W, C)
        In the sample type of the pictures, RGB order; 0 where no picture lies.
    alpha : ndarray of shape (H, W), uint8
        255 where a picture lies, else 0.
    canvas : Canvas
        Geometry of ``pixels``, after cropping.
    exposure : Exposure
        What the pictures were corrected by.
    notes : tuple of str
        What the user should know, such as why nothing was cropped.
    """

    pixels: NDArray[Any]
    alpha: NDArray[np.uint8]
    canvas: Canvas
    exposure: Exposure
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """One line: its size and sample type."""
        return f"<Composite {self.canvas.size[0]} x {self.canvas.size[1]} pixels, {self.pixels.dtype}>"


@dataclass(frozen=True, repr=False)
class FileComposite:
    """A stitched picture that went to a file; attributes as of :class:`Composite`.

    Attributes
    ----------
    path : Path
    coverage : float
        Share of the output that pictures cover.
    fingerprint : Fingerprint
        Size and digest of the file.
    seams : SeamMap or None
        Which picture owns what of the canvas before cropping; None without seams.
    origin : (int, int)
        Where the output begins in that canvas, pixels.
    """

    path: Path
    canvas: Canvas
    exposure: Exposure
    coverage: float
    fingerprint: Fingerprint
    notes: tuple[str, ...] = ()
    seams: SeamMap | None = None
    origin: tuple[int, int] = (0, 0)

    def __repr__(self) -> str:
        """One line: its file and size."""
        return f"<FileComposite {self.path}: {self.canvas.size[0]} x {self.canvas.size[1]} pixels>"


def compose(
    sources: Sequence[PictureLoader],
    cameras: Sequence[Camera],
    homographies: ArrayLike,
    canvas: Canvas,
    options: CompositeOptions | None = None,
    progress: ShareProgress | None = None,
    previews: Sequence[Preview] | None = None,
    exposures: Sequence[float | None] | None = None,
    displacements: Sequence[Displacement | None] | None = None,
) -> Composite:
    """Put pictures together on a canvas, in memory.

    Parameters
    ----------
    sources : sequence of callables
        Each reads one picture (:func:`rdstitch.io.read_image`); called in other threads, before its tiles come, and
        perhaps again later.
    cameras : sequence of Camera
    homographies : array_like of shape (N, 3, 3)
        Normalized undistorted coordinates of each picture to plane coordinates.
    canvas : Canvas
        From :func:`rdstitch.compositing.plan_canvas` with the same cameras and homographies.
    options : CompositeOptions, optional
    progress : callable, optional
        Told the share of the work done, 0 to 1.
    previews : sequence of callables, optional
        Each reads one picture reduced by the factor that it is given, 2, 4 or 8, which for JPEG files is much faster;
        otherwise the whole pictures are read once more, for what is decided on small versions of them.
    exposures : sequence of float or None, optional
        Exposure of each picture as the camera wrote it down (time x sensitivity / f-number²), up to a common factor.
    displacements : sequence of callables or None, optional
        Of each picture, what local alignment adds to its measured pixels; see :class:`rdstitch.compositing.warp.Warp`.

    Returns
    -------
    Composite

    Raises
    ------
    ArgumentError
        When the arguments do not fit together.
    InputError
        When a picture cannot be read.
    LimitError
        When the memory limit is too low.
    """
    with prepare_composite(
        sources, cameras, homographies, canvas, options, progress, previews, exposures, displacements
    ) as prepared:
        renderer, (width, height) = prepared.renderer, prepared.canvas.size
        pixels = np.zeros((height, width, renderer.channels), dtype=renderer.dtype)
        alpha = np.zeros((height, width), dtype=np.uint8)
        top = 0
        with closing(prepared.strips(progress)) as strips:
            for samples, opaque in strips:
                pixels[top : top + len(samples)], alpha[top : top + len(samples)] = samples, opaque
                top += len(samples)
    shaped = pixels if renderer.channels > 1 else pixels[..., 0]
    return Composite(shaped, alpha, prepared.canvas, renderer.exposure, prepared.notes)


def compose_to_file(
    path: str | Path,
    sources: Sequence[PictureLoader],
    cameras: Sequence[Camera],
    homographies: ArrayLike,
    canvas: Canvas,
    options: CompositeOptions | None = None,
    metadata: Metadata | None = None,
    progress: ShareProgress | None = None,
    extra_tags: Callable[[Canvas], Iterable[ExtraTag]] | None = None,
    previews: Sequence[Preview] | None = None,
    exposures: Sequence[float | None] | None = None,
    displacements: Sequence[Displacement | None] | None = None,
    *,
    outputs: Outputs | None = None,
) -> FileComposite:
    """Put pictures together straight into a file, whatever its size: memory is that of a strip of tiles.

    Parameters
    ----------
    path
        ``.tif`` (tiled, with overviews, BigTIFF where needed), ``.dzi`` (Deep Zoom), ``.png``, ``.jpg``, or ``.webp``
        (held in memory whole).
    sources, cameras, homographies, canvas, options, progress, previews, exposures, displacements
        As for :func:`compose`.
    metadata : Metadata, optional
        Colour profile, EXIF and resolution to keep.
    extra_tags : callable, optional
        Gives further tags of a TIFF file for the canvas after cropping.
    outputs : Outputs, optional
        Where the file is staged, to be published with what belongs to it; without, it replaces what is there.

    Raises
    ------
    ArgumentError, InputError, LimitError
        As for :func:`compose`; also LimitError when the picture is too large for the format.
    OutputError
        When the file cannot be written; nothing is left behind.
    """
    covered = 0

    def counted(strips: Iterable[OutputStrip]) -> Iterator[OutputStrip]:
        nonlocal covered
        for samples, alpha in strips:
            covered += int(np.count_nonzero(alpha))
            yield samples, alpha

    with prepare_composite(
        sources, cameras, homographies, canvas, options, progress, previews, exposures, displacements
    ) as prepared:
        renderer, size = prepared.renderer, prepared.canvas.size
        layout = Layout(
            size,
            renderer.channels,
            renderer.dtype,
            transparent=True,
            metadata=replace(metadata or Metadata(size), xmp=photo_sphere_xmp(prepared.canvas)),
            quality=renderer.options.quality,
            background=renderer.options.background,
        )
        check_format(path, layout)
        check_memory(path, size, renderer.options.max_memory)
        tags = () if extra_tags is None else extra_tags(prepared.canvas)
        # Nothing goes on behind a writer that fails.
        with closing(prepared.strips(progress)) as strips:
            written = write_strips(path, layout, counted(strips), tags, outputs=outputs)
    share = covered / (size[0] * size[1])
    return FileComposite(
        Path(path),
        prepared.canvas,
        renderer.exposure,
        share,
        written,
        prepared.notes,
        renderer.seams,
        prepared.origin,
    )
