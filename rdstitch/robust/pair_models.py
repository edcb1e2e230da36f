"""The family of models of one pair, from least to most free, as parametrisations of the homography.

"rigid"       planar motion: common tilt, yaw, translation
"similarity"  the same with a change of height
"homography"  any homography

The state of the planar models is
``(ψ1, θ1, ψ2, θ2, φ, tx, ty, log height, log focal correction)``; of these the free ones are estimated.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.geometry.planar_motion import (
    ABOUT_X,
    ABOUT_Y,
    ABOUT_Z,
    PlanarMotion,
    motions_from_homographies,
    rigid_in_plane,
    rotation_from_tilt,
)
from rdstitch.robust.priors import Prior, prior_costs, prior_slopes

_TILTS, _YAW, _TX, _TY, _HEIGHT, _FOCAL = slice(0, 4), 4, 5, 6, 7, 8
_PSI, _THETA = (0, 2), (1, 3)
_COMPLEMENT = np.eye(9)[:, 1:]


@dataclass(frozen=True)
class HomographyPairModel:
    """Any homography, at unit norm: eight degrees of freedom orthogonal to H itself."""

    name: str = "homography"
    parameters: tuple[str, ...] = field(default=tuple(f"tangent_{number}" for number in range(1, 9)), repr=False)

    def initialize(self, homography: FloatArray, tilts: FloatArray | None = None) -> FloatArray:
        """The homographies at unit norm."""
        flat = homography.reshape(-1, 9)
        return np.asarray(flat / np.linalg.norm(flat, axis=1, keepdims=True))

    def homography(self, state: FloatArray) -> FloatArray:
        """H (B, 3, 3)."""
        return state.reshape(-1, 3, 3)

    def jacobian(self, state: FloatArray) -> FloatArray:
        """An orthonormal basis of the complement of H, shape (B, 9, 8): a Householder reflection's last columns."""
        axis = state.copy()
        axis[:, 0] += np.copysign(1.0, axis[:, 0])
        scaled = axis * (2.0 / np.einsum("bi,bi->b", axis, axis))[:, None]
        return np.asarray(_COMPLEMENT - axis[:, :, None] * scaled[:, None, 1:])

    def retract(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """Step along the tangent, then back to unit norm."""
        moved = state + np.einsum("bip,bp->bi", self.jacobian(state), step)
        return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))

    def prior(self, state: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Nothing is known."""
        nothing = np.zeros((len(state), len(self.parameters)))
        return nothing[:, 0], nothing, nothing

    def motion(self, state: FloatArray) -> None:
        """A homography is no planar motion."""


@dataclass(frozen=True)
class PlanarPairModel:
    """Planar motion ``H ~ K R2 Rz(φ) diag(1, 1, height) T R1' K⁻¹``, ``K = diag(focal, focal, 1)``."""

    focal: float  # focal length in half diagonals
    focal_prior: Prior | None = None  # on its logarithm; None fixes it
    tilts_known: bool = False  # whether the tilts of both images are known; otherwise they share an unknown one
    height_free: bool = False  # whether the height may change

    @cached_property
    def _free(self) -> dict[str, tuple[int, ...]]:
        """Which entries of the state each free parameter moves, by its name."""
        free: dict[str, tuple[int, ...]] = {} if self.tilts_known else {"psi": _PSI, "theta": _THETA}
        free |= {"yaw": (_YAW,), "tx": (_TX,), "ty": (_TY,)}
        if self.height_free:
            free["log_height"] = (_HEIGHT,)
        # With known tilt, a wrong focal length is hidden in the height of the plane.
        return free | ({"log_focal": (_FOCAL,)} if self.focal_free else {})

    @cached_property
    def _directions(self) -> FloatArray:
        """Directions in which each free parameter moves the state, (P, 9)."""
        return np.array([np.isin(np.arange(9), entries) for entries in self._free.values()], dtype=np.float64)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the P entries of a step."""
        return tuple(self._free)

    @property
    def focal_free(self) -> bool:
        """Whether the focal length is corrected."""
        return self.focal_prior is not None and not self.tilts_known

    @property
    def name(self) -> str:
        """Name of the model in the family."""
        return "similarity" if self.height_free else "rigid"

    def initialize(self, homography: FloatArray, tilts: FloatArray | None = None) -> FloatArray:
        """The nearest planar motions."""
        k = np.array([self.focal, self.focal, 1.0])
        h = homography * (k / k[:, None])
        if self.tilts_known:
            assert tilts is not None
            rotation = rotation_from_tilt(tilts)
            h = np.swapaxes(rotation[:, 1], 1, 2) @ h @ rotation[:, 0]
            motion = motions_from_homographies(h, np.broadcast_to([0.0, 0.0, 1.0], (len(h), 3)))
            tilt = tilts.reshape(-1, 4)
        else:
            motion = motions_from_homographies(h)
            tilt = np.tile(motion[:, :2], 2)
        height = np.log(np.maximum(motion[:, 5:], 1e-3)) if self.height_free else np.zeros((len(h), 1))
        return np.concatenate([tilt, motion[:, 2:5], height, np.zeros((len(h), 1))], axis=1)

    def motion(self, state: FloatArray) -> PlanarMotion:
        """The motion that one state (9,) describes, with the tilt of image 1 where the two differ."""
        psi, theta, _, _, yaw, tx, ty, height, _ = state.tolist()
        return PlanarMotion((psi, theta), yaw, (tx, ty), float(np.exp(height)))

    def homography(self, state: FloatArray) -> FloatArray:
        """H (B, 3, 3)."""
        rotation, motion = self._parts(state)
        h = rotation[:, 1] @ motion @ np.swapaxes(rotation[:, 0], 1, 2)
        return self._in_half_diagonals(h, state)

    def jacobian(self, state: FloatArray) -> FloatArray:
        """Derivative by the free entries of the state, shape (B, 9, P)."""
        rotation, motion = self._parts(state)
        r1, r2 = rotation[:, 0], rotation[:, 1]
        back = np.swapaxes(r1, 1, 2)
        columns = np.zeros((len(state), 9, 3, 3))
        after, before = r2 @ motion, motion @ back
        columns[:, 0] = after @ np.swapaxes(ABOUT_X @ r1, 1, 2)
        columns[:, 1] = after @ np.swapaxes(r1 @ ABOUT_Y, 1, 2)
        columns[:, 2] = ABOUT_X @ r2 @ before
        columns[:, 3] = r2 @ ABOUT_Y @ before
        columns[:, _YAW] = r2 @ ABOUT_Z @ before
        for entry, axis in ((_TX, 0), (_TY, 1)):
            columns[:, entry] = -after[:, :, axis, None] * back[:, None, 2]
        columns[:, _HEIGHT] = r2[:, :, 2, None] * motion[:, 2, 2, None, None] * back[:, None, 2]
        inner = after @ back
        columns[:, _FOCAL] = inner * (_IN_PLANE[:, None] - _IN_PLANE)
        by_state = self._in_half_diagonals(columns, state[:, None]).reshape(len(state), 9, 9)
        return np.swapaxes(self._directions @ by_state, 1, 2)

    def retract(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """Add the steps to the free entries."""
        return np.asarray(state + step @ self._directions)

    def prior(self, state: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Prior of a free focal length: its cost (B,), and the slope and curvature by a step (B, P)."""
        slope, curvature = np.zeros((2, len(state), len(self.parameters)))
        if self.focal_prior is None or not self.focal_free:
            return slope[:, 0], slope, curvature
        log_focal = math.log(self.focal) + state[:, _FOCAL:]
        slope[:, -1:], curvature[:, -1:] = prior_slopes((self.focal_prior,), log_focal)
        return prior_costs((self.focal_prior,), log_focal)[:, 0], slope, curvature

    def _parts(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations of both images (B, 2, 3, 3) and the motion as the plane sees it (B, 3, 3)."""
        motion = rigid_in_plane(state[:, _YAW], state[:, _TX : _TY + 1], np.exp(state[:, _HEIGHT]))
        return rotation_from_tilt(state[:, _TILTS].reshape(-1, 2, 2)), motion

    def _in_half_diagonals(self, h: FloatArray, state: FloatArray) -> FloatArray:
        """``K h K⁻¹`` of matrices (..., 3, 3)."""
        focal = self.focal * np.exp(state[..., _FOCAL, None, None])
        powers = _IN_PLANE[:, None] - _IN_PLANE
        return np.asarray(h * np.where(powers == 0.0, 1.0, np.where(powers > 0.0, focal, 1.0 / focal)))


_IN_PLANE = np.array([1.0, 1.0, 0.0])

PairModel = HomographyPairModel | PlanarPairModel
"""A parametrisation of the homographies of B pairs at once, in the half-diagonal frame."""
