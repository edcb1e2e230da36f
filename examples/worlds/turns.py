"""Images of a camera that is turned on the spot: the scene is a sphere of texture around it, and balls before it.

The scene has x to the right, y down and z ahead, like a camera that looks straight ahead. Its texture is laid out by
longitude, which grows to the right, and latitude, which grows downwards, both in equal steps.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import Float32Array, FloatArray
from rdstitch.synthetic.lenses import Lens, focal_length
from rdstitch.synthetic.poses import Poses
from rdstitch.synthetic.rendering import Photometry, RenderedSequence
from rdstitch.synthetic.textures import Texture, ground


def camera_rotations(heading: ArrayLike, pitch: ArrayLike = 0.0, roll: ArrayLike = 0.0) -> FloatArray:
    """Rotations (N, 3, 3) from the scene to cameras: ``(Ry(heading) Rx(pitch) Rz(roll))'``.

    Cameras look ``heading`` radians (N,) to the right and ``pitch`` upwards, and are turned by ``roll`` clockwise.
    """
    heading, pitch, roll = np.broadcast_arrays(*(np.atleast_1d(np.asarray(a, float)) for a in (heading, pitch, roll)))
    one, zero = np.ones_like(heading), np.zeros_like(heading)
    (ch, sh), (cp, sp), (cr, sr) = ((np.cos(angle), np.sin(angle)) for angle in (heading, pitch, roll))
    about_y = np.array([[ch, zero, sh], [zero, one, zero], [-sh, zero, ch]]).transpose(2, 0, 1)
    about_x = np.array([[one, zero, zero], [zero, cp, -sp], [zero, sp, cp]]).transpose(2, 0, 1)
    about_z = np.array([[cr, -sr, zero], [sr, cr, zero], [zero, zero, one]]).transpose(2, 0, 1)
    to_scene = about_y @ about_x @ about_z
    return np.ascontiguousarray(np.swapaxes(to_scene, 1, 2))


def panorama_rotations(count: int, step: float, *, rows: int = 1, jitter: float = 0.05, seed: int = 0) -> FloatArray:
    """Rotations (rows count, 3, 3) of images taken by hand, one row after the other.

    Neighbours of a row are ``step`` radians apart, rows half a radian, around the horizon; headings, pitches and rolls
    are uniform in ± ``jitter`` radians around what is aimed at.
    """
    rng = np.random.default_rng(seed)
    row, column = np.divmod(np.arange(rows * count), count)
    heading = (column - (count - 1) / 2) * step
    pitch = ((rows - 1) / 2 - row) * 0.5
    errors = rng.uniform(-jitter, jitter, (3, rows * count))
    return camera_rotations(heading + errors[0], pitch + errors[1], errors[2])


@dataclass(frozen=True)
class _Around:
    """A texture that goes on at its right border with its left one, twice as wide as it is."""

    texture: Texture

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, texels."""
        return 2 * self.texture.size[0], self.texture.size[1]

    @property
    def channels(self) -> int:
        """1 for grey, 3 for RGB."""
        return self.texture.channels

    def region(self, left: int, top: int, right: int, bottom: int) -> Float32Array:
        width = self.texture.size[0]
        rows = self.texture.region(0, top, width, bottom)
        return rows.take(np.arange(left, right) % width, axis=1)


@dataclass(frozen=True, eq=False)
class TurningSequence(RenderedSequence):
    """Images of a camera that turns about its centre; made by :func:`turning_sequence`.

    ``rotations`` (N, 3, 3) are those from the scene to each camera; ``position`` (N, 3) is each camera's centre in
    radii of the sphere: zeros for a turn on the spot, other numbers for parallax. ``near`` (K, 4) are centres and radii
    of balls that stand before the sphere, in its radii; their texture is that of the sphere behind them, seen from its
    centre.
    """

    rotations: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))
    position: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    near: FloatArray = field(default_factory=lambda: np.empty((0, 4)))

    def to_plane(self, index: int, points: ArrayLike) -> FloatArray:
        """Measured pixels (..., 2) of one image to texels of the sphere; NaN outside the lens."""
        rays = self.rays(index, points)
        if self.position[index].any():
            rays = _first_hit(self.position[index], rays, self.near)
        ahead = self.rotations[index][2]
        middle = np.arctan2(ahead[0], ahead[2])
        # The longitude relative to the image's centre has no jump within the image.
        longitude = middle + np.mod(np.arctan2(rays[..., 0], rays[..., 2]) - middle + np.pi, 2 * np.pi) - np.pi
        latitude = np.arctan2(rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
        width, height = self.texture.size[0] / 2, self.texture.size[1]
        x = width * (longitude / (2 * np.pi) + 1.0) - 0.5
        y = height * (latitude / np.pi + 0.5) - 0.5
        return np.stack([x, y], axis=-1)

    def rays(self, index: int, points: ArrayLike) -> FloatArray:
        """Directions (..., 3) in the scene of measured pixels (..., 2) of one image, of length 1."""
        pinhole = (self.lens.undistort(points) - np.asarray(self.lens.center)) / focal_length(self.lens)
        rays = np.concatenate([pinhole, np.ones((*pinhole.shape[:-1], 1))], axis=-1)
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        turned: FloatArray = rays @ self.rotations[index]
        return turned


def turning_sequence(
    lens: Lens,
    rotations: FloatArray,
    *,
    seed: int,
    photometry: Photometry | None = None,
    position: ArrayLike | None = None,
    near: ArrayLike = (),
) -> TurningSequence:
    """Images that a camera takes of a sphere around it; :class:`TurningSequence` says what the arrays are."""
    circumference = round(2 * np.pi * focal_length(lens))
    texture = ground((circumference, circumference // 2), seed=seed)
    count = len(rotations)
    where = np.zeros((count, 3)) if position is None else np.asarray(position, dtype=np.float64)
    unused = Poses.of(np.zeros((count, 2)), 1.0)
    settings = Photometry() if photometry is None else photometry
    balls = np.asarray(near, dtype=np.float64).reshape(-1, 4)
    return TurningSequence(
        _Around(texture), lens, unused, settings, seed=seed, rotations=rotations, position=where, near=balls
    )


def _first_hit(position: FloatArray, rays: FloatArray, near: FloatArray) -> FloatArray:
    """First points (..., 3) of the balls, or else of the unit sphere, that unit rays (..., 3) from a position meet."""
    along = rays @ position
    distance = np.sqrt(along**2 + 1.0 - position @ position) - along
    for x, y, z, radius in near:
        from_ball = position - (x, y, z)
        along = rays @ from_ball
        with np.errstate(invalid="ignore"):
            hit = -along - np.sqrt(along**2 + radius**2 - from_ball @ from_ball)
        distance = np.where(hit > 0.0, np.minimum(hit, distance), distance)
    met: FloatArray = position + distance[..., None] * rays
    return met
