"""The path of the camera over the plane: poses frame by frame.

Positions are in units of the camera's height above the plane, in the plane's frame: x to the right and y downwards as
the first frame sees them, yaw φ as in ``H ~ R Rz(φ) T R'``, so that a point X of the plane is seen by a camera at t in
the direction ``Rz(φ) (X - t)``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.alignment.result import Alignment, PlanarPoses
from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.planar_motion import rigid_in_plane


@dataclass(frozen=True, repr=False, eq=False)
class Trajectory:
    """Poses of the frames of a sequence, in order.

    Attributes
    ----------
    frame : ndarray of shape (F,), intp
        Number of each frame in the sequence; frames left out are missing.
    position : ndarray of shape (F, 2)
        (x, y), in units of the first frame's height, or in metres.
    yaw : ndarray of shape (F,)
        φ, radians, continuous from frame to frame.
    height : ndarray of shape (F,)
        Above the plane, in the unit of the positions.
    name : tuple of str
        Of each frame's image; empty where not known.
    source_frame : ndarray of shape (F,), intp, or None
        Number of each frame in the video or bag that it was taken from, else in the sequence.
    timestamp : ndarray of shape (F,), or None
        s; NaN where not known.
    covariance : ndarray of shape (F, 4, 4), or None
        Of x, y, height and yaw, relative to the first frame, in the unit of the positions and radians.
    length_std : float
        Relative standard deviation that all lengths of the path share; NaN where not known.
    """

    frame: NDArray[np.intp]
    position: FloatArray
    yaw: FloatArray
    height: FloatArray
    name: tuple[str, ...] = ()
    source_frame: NDArray[np.intp] | None = None
    timestamp: FloatArray | None = None
    covariance: FloatArray | None = None
    length_std: float = math.nan

    def __post_init__(self) -> None:
        count = len(self.frame)
        shapes = {"position": (count, 2), "yaw": (count,), "height": (count,), "source_frame": (count,)}
        shapes |= {"timestamp": (count,), "covariance": (count, 4, 4)}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values is not None and np.shape(values) != shape:
                raise ArgumentError(f"{name} of a trajectory of {count} frames has the shape {np.shape(values)}")
        if len(self.name) not in (0, count):
            raise ArgumentError(f"a trajectory of {count} frames has {len(self.name)} names")

    def labelled(self, names: Sequence[str], numbers: ArrayLike, timestamps: ArrayLike) -> Self:
        """The trajectory with name, number and time stamp of each image of the whole sequence."""
        chosen = self.frame
        return replace(
            self,
            name=tuple(names[k] for k in chosen),
            source_frame=np.asarray(numbers, dtype=np.intp)[chosen],
            timestamp=np.asarray(timestamps, dtype=np.float64)[chosen],
        )

    @classmethod
    def from_alignment(cls, alignment: Alignment, height: float = 1.0) -> Self:
        """The path that an alignment describes, starting at the origin with yaw zero.

        Parameters
        ----------
        alignment : Alignment
        height : float
            Height of the first frame above the plane, in whatever unit the positions shall have.

        Raises
        ------
        ArgumentError
            When the alignment has no poses (general model), or the height is not positive.
        """
        if alignment.on_sphere:
            raise ArgumentError("the camera turned on the spot: there is no path; the model tilting looks for one")
        if alignment.poses is None:
            raise ArgumentError(
                "one homography per image has no metric poses; choose a planar model (rigid, similarity or tilting)"
            )
        return replace(cls.from_poses(alignment.poses, height), length_std=alignment.length_std)

    @classmethod
    def from_poses(cls, poses: PlanarPoses, height: float = 1.0) -> Self:
        """The path through the poses that are not NaN; see :meth:`from_alignment`."""
        if not (math.isfinite(height) and height > 0.0):
            raise ArgumentError(f"height must be positive, not {height}")
        frame = np.flatnonzero(np.isfinite(poses.yaw))
        if not len(frame):
            raise ArgumentError("a trajectory needs at least one frame")
        first = frame[0]
        relative, unit = poses.relative_to(int(first)), height / poses.height[first]
        path = cls(frame, height * relative.position[frame], np.unwrap(relative.yaw[frame]), unit * poses.height[frame])
        if poses.covariance is None or poses.with_first is None:
            return path
        one, both = poses.covariance[frame], poses.with_first[frame]
        change = np.diag([unit, unit, unit, 1.0])
        change[:2, :2] = unit * rigid_in_plane(poses.yaw[first], np.zeros(2))[:2, :2]
        # The first frame moves all others: by its place, by its height, which is the unit, and by its yaw.
        first_moves = np.tile(-change, (len(frame), 1, 1))
        first_moves[:, :2, 2] = -path.position / poses.height[first]
        first_moves[:, 2, 2] = -path.height / poses.height[first]
        first_moves[:, :2, 3] = np.stack([-path.position[:, 1], path.position[:, 0]], axis=1)
        mixed = change @ both @ first_moves.transpose(0, 2, 1)
        moved = first_moves @ one[0] @ first_moves.transpose(0, 2, 1)
        covariance = change @ one @ change.T + mixed + mixed.transpose(0, 2, 1) + moved
        covariance[0] = 0.0  # exactly, which a difference of equal terms is not
        return replace(path, covariance=covariance)

    @classmethod
    def on_map(
        cls,
        poses: PlanarPoses,
        to_map: FloatArray,
        map_scale: float = 1.0,
        *,
        length_std: float = 0.0,
        scale_std: float = 0.0,
    ) -> Self:
        """The poses that are not NaN on a map: positions are (easting, -northing), so that "enu" gives both.

        Parameters
        ----------
        to_map : ndarray of shape (2, 3)
            A similarity from the plane of the poses, y downwards, to easting and northing, m on the map.
        map_scale : float
            Metres of the map per metre on the ground, in which heights are.
        length_std : float
            Relative standard deviation that all lengths of the poses share: on a map, that of the heights.
        scale_std : float
            Standard deviation of the similarity: relative of its scale, and of its direction in radians.
        """
        frame = np.flatnonzero(np.isfinite(poses.yaw))
        change = np.diag([1.0, -1.0]) @ to_map
        unit, turn = math.hypot(to_map[0, 0], to_map[1, 0]), math.atan2(to_map[1, 0], to_map[0, 0])
        unit /= map_scale
        position = poses.position[frame] @ change[:, :2].T + change[:, 2]
        path = cls(frame, position, np.unwrap(poses.yaw[frame] + turn), poses.height[frame] * unit)
        if poses.covariance is None:
            return path
        whole, length_std = np.diag([1.0, 1.0, unit, 1.0]), float(np.nan_to_num(length_std))
        whole[:2, :2] = change[:, :2]
        covariance = whole @ without_length(poses.covariance[frame], poses.position[frame], length_std) @ whole.T
        (x, y), zero = (position - change[:, 2]).T, np.zeros(len(frame))
        shared = np.array(
            [
                length_std * np.stack([zero, zero, path.height, zero]),
                scale_std * np.stack([x, y, path.height, zero]),
                scale_std * np.stack([y, -x, zero, zero + 1.0]),
            ]
        )
        covariance = covariance + np.einsum("kin,kjn->nij", shared, shared)
        return replace(path, covariance=covariance, length_std=scale_std)

    def __repr__(self) -> str:
        """One line: the number of frames and the length of the path."""
        start = f", {self.length:.3g} long, from height {self.height[0]:.3g}" if len(self) else ""
        return f"<Trajectory {len(self)} frames{start}>"

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.frame)

    @property
    def length(self) -> float:
        """Length of the path."""
        return float(np.linalg.norm(np.diff(self.position, axis=0), axis=1).sum())


def without_length(covariances: FloatArray, places: FloatArray, length_std: float) -> FloatArray:
    """The covariances (N, 4, 4) of poses at places (N, 2) by all but the length that they share."""
    along = np.pad(places, ((0, 0), (0, 2)))
    moved = np.einsum("nij,nj->ni", covariances, along)
    spread = np.maximum(np.einsum("ni,ni->n", along, moved), 1e-300)
    shared = np.minimum((length_std * (places**2).sum(axis=1)) ** 2 / spread, 1.0) / spread
    return np.asarray(covariances - shared[:, None, None] * moved[:, :, None] * moved[:, None])
