"""Where cameras, and what is straight below them, are in the output."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import to_plane

_TILT_STD = math.radians(3.0)  # of a camera that is taken to look straight down, and of an attitude
_METRIC = 1e-4  # by which the axes of a plane seen from above differ, of their length: rounding


def as_complex(points: ArrayLike) -> ComplexArray:
    """Pixels (..., 2), y down, as x - i y: as complex numbers maps have them, north up."""
    x, y = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
    return np.asarray(x - 1j * y)


@dataclass(frozen=True, eq=False)
class Views:
    """Where images, or points, are in the output: pixels as x - i y."""

    ground: ComplexArray  # (N,): middle of each image, or the point
    foot: ComplexArray  # (N,): what is straight below the camera, or the point
    height: FloatArray  # (N,): of the camera above the plane, pixels of the output; NaN where not known
    right: ComplexArray  # (N,): direction of the image's x axis, of length one
    known: Literal["poses", "attitudes", "centres", "points"]
    pixel: float = 1.0  # of the images, in the middle, pixels of the output
    focal_std: float = 0.0  # relative, of the focal length
    tilt_std: float = 0.0  # of the tilt that all images share, by their own axes, radians

    @classmethod
    def of_ground(cls, points: ComplexArray, pixel: float) -> Self:
        """Of points on the ground."""
        return cls(points, points, np.full(len(points), np.nan), np.ones_like(points), "points", pixel)

    def take(self, chosen: BoolArray | IntArray) -> Self:
        """Some of them."""
        columns: dict[str, Any] = {name: getattr(self, name)[chosen] for name in ("ground", "foot", "height", "right")}
        return replace(self, **columns)


def views_of(
    cameras: Sequence[Camera], to_output: FloatArray, nadirs: Sequence[tuple[float, float, float] | None]
) -> Views:
    """The cameras of images that ``to_output`` (N, 3, 3) takes to the output; straight down by each one's attitude."""
    each = list(zip(cameras, to_output, strict=True))
    middle = np.array([_in_output(c, h, np.array(c.image_center)) for c, h in each])
    next_pixel = np.array([_in_output(c, h, np.array(c.image_center) + np.array([1.0, 0.0])) for c, h in each])
    with np.errstate(invalid="ignore"):  # an image beyond the horizon has no middle
        right = (next_pixel - middle) / np.abs(next_pixel - middle)
    pixel = float(np.nanmedian(np.abs(next_pixel - middle)))
    focal = np.array([np.nan if c.focal is None else c.focal for c in cameras])
    if np.isfinite(focal).all() and (centres := _centres(cameras, focal, to_output)) is not None:
        known = cameras[0]
        tilt, tilt_std = known.tilt or (0.0, 0.0), known.tilt_std or (0.0, 0.0)
        # Tilt and focal length are known together far better than each is.
        rest = np.square(tilt_std) - np.square(np.array(tilt) * known.focal_log_std)
        tilt_alone = math.sqrt(max(float(rest.max()), 0.0))
        foot = as_complex(centres[:, :2])
        return Views(middle, foot, centres[:, 2], right, "poses", pixel, known.focal_log_std, tilt_alone)
    # A guess where nobody knows the focal length.
    height = np.array([c.with_guessed_focal().focal or 0.0 for c in cameras]) * np.abs(next_pixel - middle)
    below = [_below(camera, nadir) for camera, nadir in zip(cameras, nadirs, strict=True)]
    if all(pixel is not None for pixel in below):
        foot = np.array([_in_output(*one, pixel) for one, pixel in zip(each, below, strict=True) if pixel is not None])
        return Views(middle, foot, height, right, "attitudes", pixel, 0.0, _TILT_STD)
    return Views(middle, middle, height, right, "centres", pixel, 0.0, _TILT_STD)


def _in_output(camera: Camera, homography: FloatArray, pixel: FloatArray) -> complex:
    return complex(as_complex(to_plane(camera, homography, pixel[None]))[0])


def _below(camera: Camera, nadir: tuple[float, float, float] | None) -> FloatArray | None:
    """The pixel straight below a camera by its attitude; None where that is not known or not ahead."""
    if nadir is None or camera.focal is None or nadir[2] <= 0.0:
        return None
    return np.asarray(camera.distort(np.array([camera.center]) + np.array([nadir[:2]]) / nadir[2] * camera.focal)[0])


def _centres(cameras: Sequence[Camera], focal: FloatArray, to_output: FloatArray) -> FloatArray | None:
    """Centres of projection (N, 3): x, y and height above the output's plane, in its pixels.

    None where these are no images of a plane seen straight from above, as where the output is the plane of an image.
    """
    scale = np.array([camera.scale for camera in cameras]) / focal
    rays = np.linalg.inv(to_output)
    rays[:, :2] *= scale[:, None, None]
    lengths = np.linalg.norm(rays[:, :, :2], axis=1)
    rays /= lengths.mean(axis=1)[:, None, None]
    product = rays[:, :, :2].transpose(0, 2, 1) @ rays[:, :, :2]
    if not np.abs(product - np.eye(2)).max() < _METRIC:
        return None
    axes = np.concatenate([rays[:, :, :2], np.cross(rays[:, :, 0], rays[:, :, 1])[:, :, None]], axis=2)
    centres: FloatArray = -np.einsum("nij,ni->nj", axes, rays[:, :, 2])
    # The sign of a homography, and with it that of z, is arbitrary; the camera is above the plane.
    centres[:, 2] = np.abs(centres[:, 2])
    return centres
