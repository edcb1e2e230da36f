"""Poses of the camera of a sequence, one an image.

The plane's coordinates are the pixels of its texture ("texels"): X to the right, Y down, the centre of the top-left
texel at (0, 0), as in an image. The camera looks down on it: with the tilt ``R``, the yaw φ, the foot of the camera
``(cx, cy)`` and its height ``h`` in texels, the ray of a plane point is ``p ~ R Rz(φ) (X - cx, Y - cy, h)``.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.planar_motion import PlanarMotion, rigid_in_plane, rotation_from_tilt
from rdstitch.radial_homography import project
from rdstitch.synthetic.lenses import Lens, focal_length


@dataclass(frozen=True)
class Poses:
    """Poses of N images.

    Attributes
    ----------
    position : ndarray of shape (N, 2)
        Foot of the camera on the plane, texels.
    height : ndarray of shape (N,)
        Height above the plane, texels.
    yaw : ndarray of shape (N,)
        φ, radians.
    tilt : ndarray of shape (N, 2)
        (ψ, θ), radians.
    """

    position: FloatArray
    height: FloatArray
    yaw: FloatArray
    tilt: FloatArray

    def __post_init__(self) -> None:
        """Check the shapes and that the camera is above the plane."""
        n = len(self.position)
        if self.position.shape != (n, 2) or self.tilt.shape != (n, 2):
            raise ArgumentError(
                f"position and tilt must have shape (N, 2), not {self.position.shape}, {self.tilt.shape}"
            )
        if self.height.shape != (n,) or self.yaw.shape != (n,):
            raise ArgumentError(f"height and yaw must have shape ({n},), not {self.height.shape}, {self.yaw.shape}")
        if not (self.height > 0.0).all():
            raise ArgumentError("the camera must stay above the plane")

    def __len__(self) -> int:
        return len(self.position)

    @classmethod
    def of(cls, position: ArrayLike, height: ArrayLike, yaw: ArrayLike = 0.0, tilt: ArrayLike = (0.0, 0.0)) -> Self:
        """Poses at positions (N, 2); height, yaw and tilt may be shared by all images."""
        where = np.array(position, dtype=np.float64).reshape(-1, 2)
        n = len(where)
        return cls(
            where,
            np.broadcast_to(np.asarray(height, dtype=np.float64), (n,)).copy(),
            np.broadcast_to(np.asarray(yaw, dtype=np.float64), (n,)).copy(),
            np.broadcast_to(np.asarray(tilt, dtype=np.float64), (n, 2)).copy(),
        )

    def from_plane(self) -> FloatArray:
        """``R Rz(φ) [X - cx, Y - cy, h]``: texels to focal-normalized undistorted points, shape (N, 3, 3)."""
        to_camera = np.stack([rigid_in_plane(*pose) for pose in zip(self.yaw, self.position, self.height, strict=True)])
        return rotation_from_tilt(self.tilt) @ to_camera

    def motion(self, first: int, second: int) -> PlanarMotion:
        """Planar motion between two images of the same tilt."""
        if not np.array_equal(self.tilt[first], self.tilt[second]):
            raise ArgumentError(f"images {first} and {second} have different tilts: that is no planar motion")
        c, s = np.cos(self.yaw[first]), np.sin(self.yaw[first])
        shift = np.array([[c, -s], [s, c]]) @ (self.position[second] - self.position[first])
        tx, ty = shift / self.height[first]
        yaw = np.mod(self.yaw[second] - self.yaw[first] + np.pi, 2.0 * np.pi) - np.pi
        psi, theta = self.tilt[first]
        scale = float(self.height[second] / self.height[first])
        return PlanarMotion((float(psi), float(theta)), float(yaw), (float(tx), float(ty)), scale)

    def shaken(
        self, *, seed: int, position: float = 0.0, height: float = 0.0, yaw: float = 0.0, tilt: float = 0.0
    ) -> Self:
        """The same poses with independent uniform jitter on each image.

        Parameters
        ----------
        position : float
            ± texels on either coordinate.
        height : float
            ± share of the height.
        yaw, tilt : float
            ± radians, on ψ and θ alike.
        """
        rng = np.random.default_rng(seed)
        n = len(self)
        return replace(
            self,
            position=self.position + position * rng.uniform(-1.0, 1.0, (n, 2)),
            height=self.height * (1.0 + height * rng.uniform(-1.0, 1.0, n)),
            yaw=self.yaw + yaw * rng.uniform(-1.0, 1.0, n),
            tilt=self.tilt + tilt * rng.uniform(-1.0, 1.0, (n, 2)),
        )

    def moved(self, offset: ArrayLike) -> Self:
        """The same poses elsewhere on the plane, ``offset`` in texels."""
        return replace(self, position=self.position + np.asarray(offset, dtype=np.float64))


def plane_outline(lens: Lens, from_plane: FloatArray, points_per_side: int = 32) -> FloatArray:
    """Outer border of an image on the plane, texels, shape (4 points_per_side, 2); NaN beyond horizon and lens."""
    return texels_of_pixels(lens, from_plane, lens.outline(points_per_side))


def texels_of_pixels(lens: Lens, from_plane: FloatArray, points: ArrayLike) -> FloatArray:
    """Measured pixels (N, 2) to texels (..., N, 2); NaN beyond the horizon and outside the lens's domain."""
    pinhole = (lens.undistort(points) - np.asarray(lens.center)) / focal_length(lens)
    rays = np.concatenate([pinhole, np.ones((*pinhole.shape[:-1], 1))], axis=-1)
    return project(rays @ np.swapaxes(np.linalg.inv(from_plane), -2, -1))


def pixels_of_texels(lens: Lens, from_plane: FloatArray, points: ArrayLike) -> FloatArray:
    """Texels (N, 2) to measured pixels (..., N, 2), also outside the image; NaN where the camera cannot see them."""
    x = np.asarray(points, dtype=np.float64)
    homogeneous = np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)
    pinhole = project(homogeneous @ np.swapaxes(from_plane, -2, -1))
    return lens.distort(pinhole * focal_length(lens) + np.asarray(lens.center))


def fit_to_plane(lens: Lens, poses: Poses, margin: int = 16) -> tuple[Poses, tuple[int, int]]:
    """Move poses so that their images start ``margin`` texels inside the plane, and its width and height for them."""
    outlines = plane_outline(lens, poses.from_plane())
    if np.isnan(outlines).any():
        raise ArgumentError("an image sees beyond the horizon or beyond its lens; no plane can fill it")
    low = np.floor(outlines.min(axis=(0, 1))) - margin
    width, height = np.ceil(outlines.max(axis=(0, 1))) + margin - low + 1
    return poses.moved(-low), (int(width), int(height))
