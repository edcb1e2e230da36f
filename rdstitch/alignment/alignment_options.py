"""What the caller of the alignment decides, and what is given of the camera and the images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.alignment.lens_selection import LENSES
from rdstitch.alignment.motion_models import MODELS
from rdstitch.alignment.priors import CameraPriors, known_focal
from rdstitch.choices import Purpose
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera


@dataclass(frozen=True)
class AlignmentOptions:
    """What the caller decides, and what is given of the camera.

    Attributes
    ----------
    reference : int, optional
        The image that defines the plane's frame; the centre of the match graph if not given.
    model : str
        "rigid", "similarity", "tilting", "pose", "homography", or "auto": the least free one that the data allow.
    lens_known : bool
        Whether the lens is that of the cameras; estimated otherwise.
    tilt : (float, float), optional
        (ψ, θ), radians, where it is known.
    attitudes : ndarray of shape (N, 2), optional
        (ψ, θ) of each image, radians, where an IMU or a gimbal has measured them; ``tilt`` is then how the camera
        is mounted on that.
    attitudes_std : float
        Their standard deviation, radians; 0 for exact ones.
    gravity : ndarray of shape (N, 3), optional
        Direction down in the axes of each camera (right, down, ahead), where it is known; NaN elsewhere. It levels
        panoramas.
    positions : ndarray of shape (N, 2), optional
        Metres east and north where each image was taken; NaN where that is not known. A weak prior.
    lens : str
        One of :data:`rdstitch.alignment.lens_selection.LENSES`, or "auto": the simplest that the data allow.
    purpose : Purpose
        The recipe that the alignment is for.
    pose_covariance : bool
        Compute covariances of the poses, in time that grows with the square of the number of images.
    most : int
        Correspondences used of each link at most; fewer where there are thousands of links.
    """

    reference: int | None = None
    model: str = "auto"
    lens_known: bool = False
    tilt: tuple[float, float] | None = None
    attitudes: ArrayLike | None = None
    attitudes_std: float = 0.0
    gravity: ArrayLike | None = None
    positions: ArrayLike | None = None
    lens: str = "auto"
    purpose: Purpose = Purpose.MOSAIC
    pose_covariance: bool = False
    most: int = 250

    def __post_init__(self) -> None:
        """Check the values."""
        if self.model != "auto" and self.model not in MODELS:
            raise ArgumentError(f"model must be auto, {', '.join(MODELS)}, not {self.model}")
        if self.lens != "auto" and self.lens not in LENSES:
            raise ArgumentError(f"lens must be auto, {', '.join(LENSES)}, not {self.lens}")
        if self.attitudes_std < 0:
            raise ArgumentError("a standard deviation cannot be negative")

    def exact_tilts(self, count: int) -> list[tuple[float, float]] | None:
        """(ψ, θ), radians, of each of ``count`` images, where they are known exactly; None where not."""
        if self.tilt is None or (self.attitudes is not None and self.attitudes_std > 0.0):
            return None
        attitudes = np.zeros((count, 2)) if self.attitudes is None else np.asarray(self.attitudes, dtype=np.float64)
        return [(psi, theta) for psi, theta in (attitudes + self.tilt).tolist()]

    def camera_priors(self, cameras: Sequence[Camera]) -> CameraPriors:
        """As the adjustment needs it."""
        count = len(cameras)
        attitudes = np.zeros((count, 2)) if self.attitudes is None else np.asarray(self.attitudes, dtype=np.float64)
        if attitudes.shape != (count, 2) or not np.isfinite(attitudes).all():
            raise ArgumentError(f"expected one attitude (psi, theta) for each of the {count} images")
        positions = (
            np.full((count, 2), np.nan) if self.positions is None else np.asarray(self.positions, dtype=np.float64)
        )
        if positions.shape != (count, 2):
            raise ArgumentError(f"expected one position (east, north) for each of the {count} images")
        return CameraPriors(
            *known_focal(cameras),
            tilt=self.tilt or (0.0, 0.0),
            tilt_known=self.tilt is not None,
            attitudes=attitudes,
            attitudes_std=None if self.attitudes is None else self.attitudes_std,
            positions=positions,
        )

    @property
    def lenses(self) -> list[str]:
        """Lenses to be tried, from the simplest; none where the lens is given."""
        if self.lens_known:
            return []
        return list(LENSES) if self.lens == "auto" else [self.lens]

    @property
    def models(self) -> list[str]:
        """Models to be tried, from the least to the most free."""
        if self.model != "auto":
            return [self.model]
        # Measured attitudes are a prior of the tilts; exact ones leave nothing of the tilts free.
        measured, exact = self.attitudes is not None, self.attitudes is not None and self.attitudes_std == 0.0
        without = {"tilting": exact, "pose": measured}
        return [name for name in MODELS if not without.get(name, False)]
