"""What the caller of the alignment decides, and what is given of the camera and the images."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.alignment.least_squares.plane_marks import ControlPoints, Sighting
from rdstitch.alignment.least_squares.priors import CameraPriors
from rdstitch.alignment.lens.lens_selection import LENSES
from rdstitch.alignment.motion_models import MODELS
from rdstitch.arrays import FloatArray, as_numbers
from rdstitch.choices import LensName, ModelName, Purpose
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.places import contradicting_places
from rdstitch.inputs.delays import DELAYS
from rdstitch.matching.links import Link
from rdstitch.robust.priors import known_focal

FEWEST_MATCHES = 5
"""Of a link: through four points goes a homography, whichever they are."""


@dataclass(frozen=True, eq=False)
class AlignmentOptions:
    """What the caller decides, and what is given of the camera."""

    reference: int | None = None  # image that defines the plane's frame; None: the centre of the match graph
    model: ModelName = "auto"  # "auto": the least free one that the data allow
    lens_known: bool = False  # whether the lens is that of the cameras
    tilt: tuple[float, float] | None = None  # (ψ, θ), radians
    # (ψ, θ) of each image (N, 2), radians, by an IMU or a gimbal; ``tilt`` is then how the camera is mounted on that
    attitudes: ArrayLike | None = None
    delayed_attitudes: FloatArray | None = None  # (N, S, 2): the same if late by rdstitch.inputs.delays.DELAYS
    attitudes_std: float = 0.0  # radians; 0: exact
    # direction down (N, 3) in the axes of each camera (right, down, ahead); NaN where unknown; it levels panoramas
    gravity: ArrayLike | None = None
    positions: ArrayLike | None = None  # metres east and north (N, 2); NaN where unknown; a prior
    positions_std: ArrayLike | None = None  # standard deviation (N,) of one coordinate of these, m; NaN where unknown
    control: tuple[Sighting, ...] = ()  # ground control points in the images; a prior where there are three or more
    lens: LensName = "auto"  # "auto": the simplest that the data allow
    purpose: Purpose = Purpose.MOSAIC
    pose_covariance: bool = False  # its time grows with the square of the number of images
    # correspondences used of each link; fewer of thousands of links, more of the few of a turn on the spot
    max_matches_per_link: int = 250

    def __post_init__(self) -> None:
        for name, choices in (("model", get_args(ModelName)), ("lens", get_args(LensName))):
            if getattr(self, name) not in choices:
                raise ArgumentError(f"{name} must be one of {', '.join(choices)}, not {getattr(self, name)!r}")
        if self.tilt is not None and (np.shape(self.tilt) != (2,) or not np.isfinite(self.tilt).all()):
            raise ArgumentError(f"tilt must be finite (psi, theta) in radians, not {self.tilt!r}")
        if not 0.0 <= self.attitudes_std < math.inf:
            raise ArgumentError(f"attitudes_std must be a standard deviation in radians, not {self.attitudes_std}")
        if self.max_matches_per_link < FEWEST_MATCHES:
            raise ArgumentError(f"max_matches_per_link must be at least {FEWEST_MATCHES}")
        names, places, stds = ([getattr(one, of) for one in self.control] for of in ("name", "place", "std"))
        if (contradiction := contradicting_places(names, places, stds)) is not None:
            point, _, distance = contradiction
            raise ArgumentError(f"control point {names[point]} has two places, {distance:.3g} m apart")

    def exact_tilts(self, count: int) -> list[tuple[float, float]] | None:
        """(ψ, θ), radians, of each of ``count`` images, where they are known exactly; None where not."""
        if self.tilt is None or (self.attitudes is not None and self.attitudes_std > 0.0):
            return None
        attitudes = _of_images("attitudes", self.attitudes, (count, 2), missing=0.0)
        return [(psi, theta) for psi, theta in (attitudes + self.tilt).tolist()]

    def camera_priors(self, cameras: Sequence[Camera]) -> CameraPriors:
        """What is given of the cameras, as priors of the adjustment."""
        count = len(cameras)
        attitudes = _of_images("attitudes", self.attitudes, (count, 2), missing=0.0)
        delayed = self.delayed_attitudes
        if delayed is not None:
            delayed = _of_images("delayed_attitudes", delayed, (count, len(DELAYS), 2))
        if np.isnan(attitudes).any() or (delayed is not None and np.isnan(delayed).any()):
            raise ArgumentError("expected finite angles (psi, theta) of every image")
        _of_images("gravity", self.gravity, (count, 3))
        positions_std = _of_images("positions_std", self.positions_std, (count,))
        if (positions_std <= 0.0).any():
            raise ArgumentError("a standard deviation of a position must be positive, or NaN where it is not known")
        return CameraPriors(
            *known_focal(cameras),
            tilt=(0.0, 0.0) if self.tilt is None else (float(self.tilt[0]), float(self.tilt[1])),
            tilt_known=self.tilt is not None,
            attitudes=attitudes,
            attitudes_std=None if self.attitudes is None else self.attitudes_std,
            positions=_of_images("positions", self.positions, (count, 2)),
            delayed_attitudes=delayed,
            positions_std=positions_std,
            control=ControlPoints.of(self.control, cameras),
        )

    @property
    def lenses(self) -> list[LensName]:
        """Lenses to be tried, from the simplest."""
        return list(LENSES) if self.lens == "auto" else [self.lens]

    @property
    def models(self) -> list[ModelName]:
        """Models to be tried, from the least to the most free."""
        if self.model != "auto":
            return [self.model]
        # Measured attitudes are a prior of the tilts, which are free within it; exact ones leave nothing of them free.
        measured, exact = self.attitudes is not None, self.attitudes is not None and self.attitudes_std == 0.0
        inexact = measured and not exact
        without = {"rigid": inexact, "similarity": inexact, "tilting": exact, "pose": measured}
        return [name for name in MODELS if not without.get(name, False)]


@dataclass(frozen=True, eq=False)
class GivenImages:
    """Images to be aligned."""

    cameras: Sequence[Camera]
    links: Sequence[Link]
    options: AlignmentOptions
    # Images that show almost only what another one shows, each with that one, and their links: they are placed
    # by these when all the rest is known
    near_copies: Mapping[int, int] = field(default_factory=dict)
    links_of_copies: Sequence[Link] = ()


def _of_images(name: str, given: ArrayLike | None, shape: tuple[int, ...], missing: float = math.nan) -> FloatArray:
    """What is given of each image, of this shape; ``missing`` where nothing is."""
    values = np.full(shape, missing) if given is None else as_numbers(name, given)
    if values.shape != shape:
        raise ArgumentError(f"{name} must have the shape {shape}, one row for each image, not {values.shape}")
    if np.isinf(values).any():
        raise ArgumentError(f"{name} must be finite")
    return values
