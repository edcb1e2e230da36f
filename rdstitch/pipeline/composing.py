"""The last stage of every picture: from registered pictures to pixels."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from rdstitch.camera import Camera
from rdstitch.compositing import Composite, CompositeOptions, compose, plan_canvas
from rdstitch.io.write import check_size
from rdstitch.pipeline.progress import Progress
from rdstitch.pipeline.sources import Source, readers


def compose_pictures(
    sources: Sequence[Source],
    cameras: Sequence[Camera],
    homographies: ArrayLike,
    reference: int | None,
    output: str | Path | None,
    options: CompositeOptions,
    threads: int,
    progress: Progress,
) -> Composite:
    """Plan the canvas, see whether a file can hold it, and put the pictures on it.

    Parameters
    ----------
    sources, cameras : sequence
        Of the pictures that are used.
    homographies : array_like of shape (N, 3, 3)
        Normalized undistorted coordinates of each picture to the plane.
    reference : int or None
        Picture whose resolution the output has; None for the median one's.
    output : path or None
        File that the picture will be written to.
    options : CompositeOptions
    threads : int
    progress : callable
    """
    names = [source.name for source in sources]
    canvas = plan_canvas(
        cameras, homographies, scale=options.scale, rotate=options.rotate, reference=reference, names=names
    )
    if output is not None:
        check_size(output, canvas.size)
    return compose(
        readers(sources),
        cameras,
        homographies,
        canvas,
        replace(options, workers=threads),
        progress=lambda share: progress("compositing", round(100 * share), 100),
    )
