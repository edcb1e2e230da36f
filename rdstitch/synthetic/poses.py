"""Poses of the camera of a sequence, one an image; ready-made ones: pairs and grids.

The plane's coordinates are the pixels of its texture ("texels"): X to the right, Y down, the centre of the top-left
texel at (0, 0), as in an image. The camera looks down on it: with the tilt ``R``, the yaw φ, the foot of the camera
``(cx, cy)`` and its height ``h`` in texels, the ray of a plane point is ``p ~ R Rz(φ) (X - cx, Y - cy, h)``.

Ready-made poses lie anywhere on the plane, which :func:`rdstitch.synthetic.sequence_over` makes large enough; a pixel
at the image's centre shows one texel. Overlaps are fractions of what the lens sees of the plane along its middle row or
column, so that a barrel lens takes longer steps.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.planar_motion import PlanarMotion, rigid_in_plane, rotation_from_tilt
from rdstitch.geometry.radial_homography import project
from rdstitch.synthetic.lenses import Lens, focal_length

Tilt = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of N images."""

    position: FloatArray  # (N, 2): foot of the camera on the plane, texels
    height: FloatArray  # (N,): above the plane, texels
    yaw: FloatArray  # (N,): φ, radians
    tilt: FloatArray  # (N, 2): ψ and θ, radians

    def __post_init__(self) -> None:
        if not all(np.isfinite(values).all() for values in vars(self).values()):
            raise ArgumentError("poses must be finite")
        if not (self.height > 0.0).all():
            raise ArgumentError("the camera must stay above the plane")

    def __len__(self) -> int:
        return len(self.position)

    @classmethod
    def of(cls, position: ArrayLike, height: ArrayLike, yaw: ArrayLike = 0.0, tilt: ArrayLike = (0.0, 0.0)) -> Self:
        """Poses at positions (N, 2); height, yaw and tilt may be shared by all images."""
        where = np.array(position, dtype=np.float64).reshape(-1, 2)
        shapes = ((height, where.shape[:1]), (yaw, where.shape[:1]), (tilt, where.shape))
        return cls(where, *(np.broadcast_to(np.asarray(value, np.float64), shape).copy() for value, shape in shapes))

    def from_plane(self) -> FloatArray:
        """``R Rz(φ) [X - cx, Y - cy, h]``: texels to focal-normalized undistorted points, shape (N, 3, 3)."""
        to_camera = np.stack([rigid_in_plane(*pose) for pose in zip(self.yaw, self.position, self.height, strict=True)])
        return rotation_from_tilt(self.tilt) @ to_camera

    def motion(self, first: int, second: int) -> PlanarMotion:
        """Planar motion between two images of the same tilt."""
        if not np.array_equal(self.tilt[first], self.tilt[second]):
            raise ArgumentError(f"images {first} and {second} have different tilts: that is not planar motion")
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

        Within ± ``position`` texels on either coordinate, ± a share of the height, ± ``yaw`` radians, and ± ``tilt``
        radians on ψ and θ alike.
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


def pair_poses(
    lens: Lens,
    overlap: float = 0.3,
    *,
    yaw: float = 0.0,
    direction: float = 0.0,
    scale: float = 1.0,
    tilt: Tilt = (0.0, 0.0),
) -> Poses:
    """Two images.

    Of the extent along ``direction``, radians from the plane's X axis, both show the share ``overlap``. The second
    image is turned by ``yaw`` radians, and ``scale`` times as high as the first.
    """
    along = np.array([np.cos(direction), np.sin(direction)])
    extent = np.min(extent_of(lens, tilt) / np.maximum(np.abs(along), 1e-12))
    height = focal_length(lens) * np.array([1.0, scale])
    return Poses.of([(0.0, 0.0), (1.0 - overlap) * extent * along], height, [0.0, yaw], tilt)


def grid_poses(
    lens: Lens,
    columns: int,
    rows: int,
    *,
    overlap: float = 0.4,
    yaw: float = 0.0,
    shift: float = 0.0,
    tilt: Tilt = (0.0, 0.0),
    seed: int = 0,
) -> Poses:
    """Views side by side, row after row, each second row backwards.

    Neighbours share ``overlap`` along both axes. Each image is turned by a random angle within ± ``yaw`` radians, and
    moved by a random share, within ± ``shift``, of the step to its neighbours.
    """
    step = (1.0 - overlap) * extent_of(lens, tilt)
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    j[1::2] = j[1::2, ::-1]
    places = np.column_stack([j.ravel(), i.ravel()]).astype(np.float64)
    places += shift * np.random.default_rng((seed, 1)).uniform(-1.0, 1.0, places.shape)
    poses = Poses.of(places * step, focal_length(lens), 0.0, tilt)
    return poses.shaken(seed=seed, yaw=yaw)


def extent_of(lens: Lens, tilt: Tilt) -> FloatArray:
    """Width and height in texels that an image shows of the plane along its middle row and column."""
    pose = Poses.of((0.0, 0.0), focal_length(lens), 0.0, tilt)
    top, right, bottom, left = plane_outline(lens, pose.from_plane()[0], 2)[1::2]
    extent = np.array([np.linalg.norm(right - left), np.linalg.norm(bottom - top)])
    if not np.isfinite(extent).all():
        raise ArgumentError("the image sees beyond the horizon or beyond its lens")
    return extent
