"""Problem instances of rotation about the camera's centre, with known truth, in batches."""

from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.synthetic.instances import HALF_SIZE, Instances, Range, visible_points


@dataclass(frozen=True)
class RotationInstances(Instances):
    """Instances of rotation: ``H = K R K⁻¹``, ``K = diag(g, g, 1)``.

    Attributes
    ----------
    rotation : ndarray of shape (B, 3, 3)
    focal : ndarray of shape (B,)
        g, in the unit of the points.
    """

    rotation: FloatArray
    focal: FloatArray


def rotation_instances(
    count: int,
    points: int,
    *,
    seed: int,
    distortion: Range = (-0.7, 0.0),
    angle: Range = (0.1, 0.7),
    roll: float = np.pi,
    focal: Range = (1.0, 1.0),
    half_size: Range = HALF_SIZE,
    overlap: float = 0.1,
    noise: float = 0.0,
) -> RotationInstances:
    """Random rotations of a camera with radial distortion about its centre.

    Parameters
    ----------
    count, points : int
        B and k: instances, and correspondences in each.
    seed : int
        Equal seeds give equal instances.
    distortion : (float, float)
        Range of λ, uniform, in the frame of the points.
    angle : (float, float)
        Range of the angle between the optical axes, radians; their direction is uniform.
    roll : float
        The camera is turned about its axis by up to ± this, radians.
    focal : (float, float)
        Range of g, in the unit of the points.
    half_size : (float, float)
        Half width and half height of the pictures, in the unit of the points.
    overlap : float
        Least share of picture 1 that picture 2 sees, roughly; rotations with less are drawn again.
    noise : float
        Standard deviation of the normal noise added to both pictures' points.
    """
    rng = np.random.default_rng(seed)
    lam = rng.uniform(*distortion, count)
    length = rng.uniform(*focal, count)
    k = np.stack([length, length, np.ones(count)], axis=-1)

    def draw(which: np.ndarray) -> FloatArray:
        direction, by = rng.uniform(-np.pi, np.pi, len(which)), rng.uniform(*angle, len(which))
        turned = rng.uniform(-roll, roll, len(which))
        about = np.stack([np.cos(direction), np.sin(direction), np.zeros(len(which))], axis=-1)
        rotation = _about(about, by) @ _about(np.tile([0.0, 0.0, 1.0], (len(which), 1)), turned)
        return np.asarray(rotation * (k[which][:, :, None] / k[which][:, None, :]))

    # In front of picture 1 every ray counts, however oblique: there is no plane that it should meet.
    ahead = np.tile([0.0, 0.0, 1.0], (count, 1))
    x1, x2, h = visible_points(rng, lam, ahead, points, half_size, overlap, draw)
    return RotationInstances(
        x1=x1 + noise * rng.standard_normal(x1.shape),
        x2=x2 + noise * rng.standard_normal(x2.shape),
        homography=h,
        distortion=lam,
        rotation=h * (k[:, None, :] / k[:, :, None]),
        focal=length,
    )


def _about(axes: FloatArray, angles: FloatArray) -> FloatArray:
    """Rotations (B, 3, 3) about unit axes (B, 3) by angles (B,) (Rodrigues)."""
    x, y, z = axes.T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    sine, versine = np.sin(angles)[:, None, None], (1.0 - np.cos(angles))[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + versine * (cross @ cross))
