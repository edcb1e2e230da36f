"""The family of models of one pair, from least to most free, as parametrisations of the homography.

"rigid"       planar motion: common tilt, yaw, translation
"similarity"  the same with a change of height
"homography"  any homography

Refinement knows a model only by its four functions. The state of the planar models is
``(ψ, θ, φ, tx, ty, log height, log focal correction)``; of these the free ones are estimated.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.planar_motion import PlanarMotion, rigid_in_plane, rotation_from_tilt

Tilts = tuple[tuple[float, float], tuple[float, float]]

_PSI_THETA_YAW_TX_TY = (0, 1, 2, 3, 4)
_HEIGHT = 5
_FOCAL = 6


class PairModel(Protocol):
    """A parametrisation of the homography between two pictures, in the half-diagonal frame."""

    @property
    def name(self) -> str:
        """Name of the model in the family."""
        ...

    def initialize(self, homography: FloatArray) -> FloatArray:
        """State that describes a homography, or comes close."""
        ...

    def homography(self, state: FloatArray) -> FloatArray:
        """H (3, 3)."""
        ...

    def jacobian(self, state: FloatArray) -> FloatArray:
        """Derivative of the entries of H, row by row, by a step, shape (9, P)."""
        ...

    def retract(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """The state after a step of shape (P,)."""
        ...

    def prior(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What is known beforehand: residuals in standard deviations (K,), and their derivative (K, P)."""
        ...


@dataclass(frozen=True)
class HomographyModel:
    """Any homography, at unit norm: eight degrees of freedom orthogonal to H itself."""

    name: str = "homography"

    def initialize(self, homography: FloatArray) -> FloatArray:
        """The homography at unit norm."""
        return np.asarray(homography / np.linalg.norm(homography)).ravel()

    def homography(self, state: FloatArray) -> FloatArray:
        """H (3, 3)."""
        return state.reshape(3, 3)

    def jacobian(self, state: FloatArray) -> FloatArray:
        """An orthonormal basis of the complement of H, shape (9, 8): a Householder reflection's last columns."""
        axis = state.copy()
        axis[0] += np.copysign(1.0, axis[0])
        reflection = np.eye(9) - 2.0 * np.outer(axis, axis) / (axis @ axis)
        return np.asarray(reflection[:, 1:])

    def retract(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """Step along the tangent, then back to unit norm."""
        moved = state + self.jacobian(state) @ step
        return np.asarray(moved / np.linalg.norm(moved))

    def prior(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Nothing is known."""
        return np.empty(0), np.empty((0, 8))


@dataclass(frozen=True)
class PlanarModel:
    """Planar motion ``H ~ K R2 Rz(φ) diag(1, 1, height) T R1' K⁻¹``, ``K = diag(focal, focal, 1)``.

    Attributes
    ----------
    focal : float
        Focal length in half diagonals.
    focal_std : float
        Standard deviation of its logarithm; 0 fixes it.
    tilts : pair of (float, float) or None
        Known tilts of picture 1 and picture 2, radians; None where an unknown tilt is shared.
    height_free : bool
        Whether the height may change.
    """

    focal: float
    focal_std: float = 0.0
    tilts: Tilts | None = None
    height_free: bool = False
    _free: tuple[int, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Note which entries of the state are free."""
        free = [i for i in _PSI_THETA_YAW_TX_TY if self.tilts is None or i > 1]
        if self.height_free:
            free.append(_HEIGHT)
        # With known tilt, a wrong focal length is hidden in the height of the plane.
        if self.focal_std > 0.0 and self.tilts is None:
            free.append(_FOCAL)
        object.__setattr__(self, "_free", tuple(free))

    @property
    def name(self) -> str:
        """Name of the model in the family."""
        return "similarity" if self.height_free else "rigid"

    def initialize(self, homography: FloatArray) -> FloatArray:
        """The nearest planar motion."""
        k = self._calibration(0.0)
        h = np.linalg.inv(k) @ homography @ k
        if self.tilts is None:
            motion = PlanarMotion.from_homography(h)
        else:
            r1, r2 = rotation_from_tilt(self.tilts)
            motion = PlanarMotion.from_homography_and_normal(r2.T @ h @ r1, np.array([0.0, 0.0, 1.0]))
        height = np.log(max(motion.height, 1e-3)) if self.height_free else 0.0
        return np.array([*motion.tilt, motion.yaw, *motion.translation, height, 0.0])

    def motion(self, state: FloatArray) -> PlanarMotion:
        """The motion that a state stands for (with the tilt of picture 1 where the two are known)."""
        tilt = (float(state[0]), float(state[1])) if self.tilts is None else self.tilts[0]
        return PlanarMotion(tilt, float(state[2]), (float(state[3]), float(state[4])), float(np.exp(state[_HEIGHT])))

    def focal_correction(self, state: FloatArray) -> float:
        """Factor by which the focal length was corrected."""
        return float(np.exp(state[_FOCAL]))

    def homography(self, state: FloatArray) -> FloatArray:
        """H (3, 3)."""
        r1, r2 = self._rotations(state)
        k = self._calibration(state[_FOCAL])
        motion = rigid_in_plane(state[2], state[3:5], np.exp(state[_HEIGHT]))
        return np.asarray(k @ r2 @ motion @ r1.T @ np.linalg.inv(k))

    def jacobian(self, state: FloatArray) -> FloatArray:
        """Derivative by the free entries of the state, shape (9, P)."""
        r1, r2 = self._rotations(state)
        k = self._calibration(state[_FOCAL])
        k_inverse = np.linalg.inv(k)
        motion = rigid_in_plane(state[2], state[3:5], np.exp(state[_HEIGHT]))
        columns: dict[int, FloatArray] = {}
        if self.tilts is None:
            by_psi, by_theta = _rotation_derivatives(state[0], state[1])
            columns[0] = by_psi @ motion @ r1.T + r2 @ motion @ by_psi.T
            columns[1] = by_theta @ motion @ r1.T + r2 @ motion @ by_theta.T
        columns[2] = r2 @ _QUARTER_TURN @ motion @ r1.T
        for entry, axis in ((3, 0), (4, 1)):
            by_translation = np.zeros((3, 3))
            by_translation[:, 2] = -motion[:, axis]
            columns[entry] = r2 @ by_translation @ r1.T
        by_height = np.zeros((3, 3))
        by_height[2, 2] = motion[2, 2]
        columns[_HEIGHT] = r2 @ by_height @ r1.T
        log_k = np.diag([1.0, 1.0, 0.0])
        inner = r2 @ motion @ r1.T
        columns[_FOCAL] = log_k @ inner - inner @ log_k
        return np.stack([(k @ columns[i] @ k_inverse).ravel() for i in self._free], axis=1)

    def retract(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """Add the step to the free entries."""
        moved = state.copy()
        moved[list(self._free)] += step
        return moved

    def prior(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The focal length, where it is free."""
        if _FOCAL not in self._free:
            return np.empty(0), np.empty((0, len(self._free)))
        derivative = np.zeros((1, len(self._free)))
        derivative[0, self._free.index(_FOCAL)] = 1.0 / self.focal_std
        return state[[_FOCAL]] / self.focal_std, derivative

    def _rotations(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        r1, r2 = rotation_from_tilt(np.array([state[:2], state[:2]]) if self.tilts is None else self.tilts)
        return r1, r2

    def _calibration(self, log_correction: float) -> FloatArray:
        focal = self.focal * np.exp(log_correction)
        return np.diag([focal, focal, 1.0])


_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def _rotation_derivatives(psi: float, theta: float) -> tuple[FloatArray, FloatArray]:
    """Derivatives of ``Rx(ψ) Ry(θ)`` by ψ and θ: with the generators Gx, Gy they are ``Gx R`` and ``R Gy``."""
    rotation = rotation_from_tilt((psi, theta))
    about_x = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    about_y = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    return about_x @ rotation, rotation @ about_y
