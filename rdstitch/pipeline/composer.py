"""Composing many sets of images from the same cameras in the same places, by one registration."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing.tables import CompositeTables
from rdstitch.inputs.frame import to_channel_order
from rdstitch.io.samples import split_alpha
from rdstitch.options.composite_options import Interpolation
from rdstitch.results.stitch_result import OutputImage
from rdstitch.system.native_threads import one_native_thread


class Composer:
    """Composes one set of images after another by a result: fixed cameras, frames of videos, bands.

    Where the images lie, seams and exposure are those of the result, computed once; see
    :class:`rdstitch.compositing.tables.CompositeTables` for what is simpler than in a single image.

    Parameters
    ----------
    result : StitchResult or Recomposition
        Of :func:`rdstitch.pano` or :func:`rdstitch.mosaic`, a dry run will do; or, by a sidecar,
        ``rdstitch.apply(sidecar, images, dry_run=True)``. Its images are read once more.
    interpolation : str
        "linear", "cubic" or "lanczos".

    Attributes
    ----------
    names : tuple of str
        Of the images that are drawn: the order in which :meth:`compose` takes them.
    alpha : ndarray of shape (H, W), uint8
        255 where an image lies, else 0.

    Raises
    ------
    InputError
        When an image cannot be read any more.

    Examples
    --------
    >>> import cv2
    >>> import rdstitch
    >>> composer = rdstitch.Composer(rdstitch.pano(["left.png", "middle.png"]))
    >>> composer.compose([cv2.imread(name) for name in composer.names]).shape[2]
    3
    """

    @one_native_thread()
    def __init__(self, result: OutputImage, interpolation: Interpolation = "linear") -> None:
        placed, options = result.placed, replace(result.options.composite, interpolation=interpolation)
        images = placed.images(result.canvas)
        self.names = tuple(source.name for source in placed.sources)
        self._tables, self._order = CompositeTables.of(images, result.canvas, options), result.options.channel_order
        self.alpha = self._tables.alpha

    @one_native_thread()
    def compose(self, images: Iterable[NDArray[Any]]) -> NDArray[Any]:
        """Put one set of images together, (H, W) or (H, W, C).

        Parameters
        ----------
        images : iterable of ndarray of shape (h, w) or (h, w, C)
            One for each of :attr:`names`, of its size; uint8, uint16 or float32, channels in the order of the
            result's images. Alpha, the last of two or four channels that the result has fewer of, is
            left out.

        Raises
        ------
        ArgumentError
            When number, size or kind of the images is another.
        """
        arrays = map(np.asarray, images)
        given = [a if a.shape[2:] == (self._tables.channels,) else split_alpha(a)[0] for a in arrays]
        self._tables.check(given)
        return to_channel_order(
            self._tables.compose([to_channel_order(image, self._order) for image in given]), self._order
        )
