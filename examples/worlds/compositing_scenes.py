"""Rendered sets with known homographies, for the compositor alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from examples.judging.comparison import plane_under
from rdstitch.arrays import FloatArray
from rdstitch.compositing import Canvas, Composite, CompositeOptions, PlacedImage, compose, plan_canvas
from rdstitch.compositing.source_images import Displacement, ImageLoader
from rdstitch.geometry.camera import Camera
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage, reduced
from rdstitch.synthetic.poses import grid_poses
from rdstitch.synthetic.rendering import Photometry, RenderedSequence, sequence_over
from rdstitch.synthetic.textures import ground


@dataclass(frozen=True)
class Scene:
    """Images of a plane with their true cameras and homographies, and the canvas they give."""

    rendering: RenderedSequence
    frames: Sequence[NDArray[Any]]
    cameras: Sequence[Camera]
    homographies: FloatArray
    canvas: Canvas

    @property
    def sources(self) -> list[ImageLoader]:
        return [loader(as_image(frame)) for frame in self.frames]

    @property
    def images(self) -> list[PlacedImage]:
        return place_images(self.sources, self.cameras, self.homographies)

    def composed(self, frames: Sequence[NDArray[Any]] | None = None, **options: Any) -> Composite:
        """The images, or other ones from the same places, as one."""
        sources = self.sources if frames is None else [loader(as_image(frame)) for frame in frames]
        images = place_images(sources, self.cameras, self.homographies)
        return compose(images, self.canvas, CompositeOptions(**options))

    def truth(self, canvas: Canvas | None = None) -> NDArray[np.float32]:
        """The plane as a perfect composite shows it: grey (h, w), 0 to 1."""
        drawn, _ = plane_under(self.rendering.texture, np.linalg.inv((canvas or self.canvas).matrix), self.canvas.size)
        return drawn.astype(np.float32)


def as_image(frame: NDArray[Any], alpha: NDArray[np.uint8] | None = None) -> DecodedImage:
    """An image as if it had been read from a file."""
    return DecodedImage(frame, alpha, Metadata((frame.shape[1], frame.shape[0])))


def loader(image: DecodedImage) -> ImageLoader:
    """What reads an image that is in memory."""
    return partial(reduced, image)


def render(columns: int = 3, rows: int = 2, **options: Any) -> Scene:
    """Views side by side with tilt, yaw and lens distortion; the options are those of :func:`_rendered`."""
    return _rendered(columns, rows, **options) if "photometry" in options else _kept(columns, rows, **options)


def _rendered(
    columns: int = 3,
    rows: int = 2,
    *,
    size: tuple[int, int] = (320, 240),
    distortion: float = -0.25,
    channels: int = 3,
    overlap: float = 0.45,
    photometry: Photometry | None = None,
    seed: int = 0,
    **canvas_options: Any,
) -> Scene:
    lens = Camera(size, distortion=distortion, focal=0.8 * size[0])
    poses = grid_poses(lens, columns, rows, overlap=overlap, yaw=0.12, shift=0.08, tilt=(0.04, -0.03), seed=seed)
    rendering = sequence_over(partial(ground, seed=seed + 1, channels=channels), lens, poses, photometry=photometry)
    scale = np.diag([lens.scale / lens.focal] * 2 + [1.0])
    matrices = np.stack([np.linalg.inv(rendering.from_plane(i)) @ scale for i in range(len(rendering))])
    cameras = [lens] * len(rendering)
    return Scene(rendering, rendering.frames(), cameras, matrices, plan_canvas(cameras, matrices, **canvas_options))


_kept = cache(_rendered)


def grey(pixels: NDArray[Any]) -> NDArray[np.float32]:
    """Mean of the channels, 0 to 1."""
    full = np.iinfo(pixels.dtype).max
    values = pixels.astype(np.float32) / np.float32(full)
    return values if values.ndim == 2 else values.mean(axis=2, dtype=np.float32)


def gradient(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.hypot(*(cv2.Sobel(values, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (1, 0)))


def inner(alpha: NDArray[np.uint8], margin: int = 4) -> NDArray[np.bool_]:
    """Covered px at least ``margin`` px from what is not."""
    kernel = np.ones((2 * margin + 1,) * 2, np.uint8)
    return cv2.erode((alpha > 0).astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=(0,)) > 0


def side_by_side(frames: Sequence[NDArray[Any]], places: Sequence[tuple[float, float]], **options: Any) -> Composite:
    """Frames of one size that lie at these places in a plane, pixels, as one."""
    lens = Camera((frames[0].shape[1], frames[0].shape[0]))
    homographies = np.tile(np.eye(3), (len(places), 1, 1))
    homographies[:, :2, 2] = np.array(places) / lens.scale
    cameras = [lens] * len(places)
    images = place_images([loader(as_image(frame)) for frame in frames], cameras, homographies)
    return compose(images, plan_canvas(cameras, homographies), CompositeOptions(**options))


def place_images(
    loaders: Sequence[ImageLoader],
    cameras: Sequence[Camera],
    homographies: ArrayLike,
    *,
    exposure: Sequence[float | None] | None = None,
    displacement: Sequence[Displacement | None] | None = None,
    paths: Sequence[str] | None = None,
) -> list[PlacedImage]:
    """Images from lists of what is known of each; see :class:`PlacedImage`."""
    count, matrices = len(loaders), np.asarray(homographies, dtype=np.float64)
    nothing = [None] * count
    more = (exposure or nothing, displacement or nothing, paths or [""] * count)
    return [PlacedImage(*known) for known in zip(loaders, cameras, matrices, *more, strict=True)]
