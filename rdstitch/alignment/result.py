"""What the adjustment gives: the cameras and poses of all images over one plane."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.alignment.motion_models import LOG_HEIGHT, MODELS, PSI, THETA, YAW, X, Y
from rdstitch.arrays import FloatArray, Rows
from rdstitch.choices import LensName, ModelName
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import rigid_in_plane
from rdstitch.geometry.radial_homography import from_plane, to_plane
from rdstitch.results.messages import Message


class Unused(StrEnum):
    """Why the alignment was not adjusted to a link that fits well on its own."""

    NO = ""
    CONTRADICTS = "contradicts the other links"
    ELSEWHERE = "belongs to another group of images"
    COPY = "counted once: one of its images is a copy"


@dataclass(frozen=True)
class LinkFit:
    """How well one link agrees with the whole."""

    image1: int  # image1, image2: indices of the images
    image2: int
    count: int  # correspondences given
    inliers: int  # correspondences that agree with the alignment
    rms: float  # root mean square error of those, pixels; NaN where the link was not used
    reason: Unused = Unused.NO  # why the link was not used

    @property
    def used(self) -> bool:
        """Whether the alignment was adjusted to the link."""
        return self.reason is Unused.NO

    @property
    def images(self) -> tuple[int, int]:
        """Indices of both images."""
        return self.image1, self.image2


@dataclass(frozen=True, eq=False)
class PlanarPoses(Rows):
    """Where the camera was for each image, in a metric plane."""

    yaw: FloatArray  # (N,): φ, radians
    position: FloatArray  # (N, 2): (x, y) in the plane, in units of the reference image's height above it
    height: FloatArray  # (N,): height above the plane in the same unit
    tilt: FloatArray  # (N, 2): (ψ, θ), radians
    # covariance, with_first: (N, 4, 4): of x, y, height and yaw: of each image, and of each with the first that is
    # used, where they were asked for
    covariance: FloatArray | None = None
    with_first: FloatArray | None = None

    @classmethod
    def of(cls, metric: FloatArray) -> Self:
        """Convert poses (N, 6) in metric units, in the columns of the planar models; without covariances."""
        return cls(metric[:, YAW], metric[:, [X, Y]], np.exp(metric[:, LOG_HEIGHT]), metric[:, [PSI, THETA]])

    def relative_to(self, reference: int) -> "PlanarPoses":
        """The poses in the frame of one image: at the origin, with yaw zero, its height the unit; no covariances."""
        unit, turn = self.height[reference], rigid_in_plane(self.yaw[reference], np.zeros(2))[:2, :2]
        position = (self.position - self.position[reference]) @ turn.T / unit
        yaw = np.remainder(self.yaw - self.yaw[reference] + np.pi, 2.0 * np.pi) - np.pi
        return PlanarPoses(yaw, position, self.height / unit, self.tilt)

    def turned(self, matrix: FloatArray) -> tuple[FloatArray | None, FloatArray | None]:
        """The covariances after a rotation (2, 2) of the plane."""
        if self.covariance is None or self.with_first is None:
            return None, None
        change = np.eye(4)
        change[:2, :2] = matrix
        return change @ self.covariance @ change.T, change @ self.with_first @ change.T


@dataclass(frozen=True)
class ReliefTest:
    """Whether the scene is the plane that it is taken for."""

    found: bool  # the residuals of neighbouring points agree too well to be noise
    coherence: float  # mean correlation of the residuals of neighbouring points, 0 for noise, 1 for a smooth surface
    size: float  # root mean square of the coherent part of the residuals, pixels
    explanation: str  # one sentence; what it means for λ


@dataclass(frozen=True, repr=False, kw_only=True, eq=False)
class Alignment:
    """All images registered as one.

    Attributes
    ----------
    cameras : tuple of Camera
        The camera of each image with the estimated λ and, in planar models, focal length.
    homographies : ndarray of shape (N, 3, 3)
        From undistorted coordinates of image i, in half diagonals from its distortion centre, to the plane; the
        third coordinate is positive in front of the camera. NaN for images left out. In planar models the plane is
        metric, rectified, with its unit the height of the reference image; in the general model it is the
        undistorted reference image. In the rotation model they lead to directions (x right, y down, z ahead) of a
        level frame, whatever their third coordinate.
    used : ndarray of shape (N,), bool
    components : tuple of tuple of int
        The groups of images that overlap: the aligned one, then those with the most images that are no copies.
    reference : int
        The image that defines the plane's frame.
    model : str
        "rigid", "similarity", "tilting", "pose", "homography" or "rotation".
    model_reason : str
        Why this model was taken.
    poses : PlanarPoses or None
        None for the general model; NaN for images left out.
    tilt_spread : float
        Standard deviation of the single images' tilts, radians; 0 where the model has none.
    lens : str
        The lens that was found, a key of :data:`rdstitch.alignment.lens.lens_selection.LENSES`.
    lens_reason : str
        Why that one.
    parameters : tuple of str
        Names of the parameters that ``covariance`` covers, among "psi", "theta", "log_focal", "distortion",
        "distortion2", "distortion3", "center_x", "center_y".
    covariance : ndarray of shape (P, P)
    rms : float
        Root mean square error of the inliers of all links, pixels.
    links : tuple of LinkFit
        In the order of the links given.
    relief : ReliefTest
    leverage : mapping
        How far (0 to 1) what is known of the map puts itself where the alignment has it: positions by the index of
        their image, control points by name.
    lever_std : float
        How far relief moves the ground in the middles of images against what is below their cameras: standard
        deviation of a coordinate, in heights of the reference image.
    messages : tuple of Message
        What the user should know of the whole: λ not observable, two cameras, ….
    """

    cameras: tuple[Camera, ...]
    homographies: FloatArray
    used: NDArray[np.bool_]
    components: tuple[tuple[int, ...], ...]
    reference: int
    model: ModelName
    model_reason: str
    rms: float
    links: tuple[LinkFit, ...]
    relief: ReliefTest
    lens: LensName = "division"
    lens_reason: str = "one parameter"
    poses: PlanarPoses | None = None
    tilt_spread: float = 0.0
    parameters: tuple[str, ...] = ()
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    leverage: Mapping[int | str, float] = field(default_factory=dict)
    lever_std: float = 0.0
    messages: tuple[Message, ...] = ()

    def __repr__(self) -> str:
        """One line: of how many images, by which motion model, and how well they agree."""
        used, count = int(self.used.sum()), len(self.used)
        return f"<Alignment {used} of {count} images, {self.model}, rms {self.rms:.2f} pixels>"

    def with_messages(self, messages: Iterable[Message]) -> Self:
        """The alignment with further messages."""
        return replace(self, messages=(*self.messages, *messages))

    def with_copies(self, copies: Mapping[int, int], pairs: Sequence[tuple[int, int]]) -> Self:
        """The alignment with copies, by index, where the images lie that they are copies of.

        The links are between the images of these pairs, one of which may be a copy.
        """
        placed = {copy: first for copy, first in copies.items() if self.used[first]}
        origin = np.arange(len(self.used))
        origin[list(placed)] = list(placed.values())
        fits = [replace(fit, image1=i, image2=j) for fit, (i, j) in zip(self.links, pairs, strict=True)]
        groups = (tuple(k for k in group if k not in copies) for group in self.components)
        return replace(
            self,
            homographies=self.homographies[origin],
            used=self.used[origin],
            poses=None if self.poses is None else self.poses.take(origin),
            links=tuple(fits),
            components=tuple(
                tuple(sorted({*group, *(copy for copy, first in copies.items() if first in group)}))
                for group in groups
                if group
            ),
        )

    def relation(self, image1: int, image2: int) -> FloatArray:
        """Homography (3, 3) from undistorted normalized coordinates of one image to those of another."""
        return np.linalg.solve(self.homographies[image2], self.homographies[image1])

    @cached_property
    def distortion(self) -> float:
        """λ of the one-parameter lens nearest to that of the reference image, see :class:`rdstitch.Camera`."""
        return self.cameras[self.reference].nearest_distortion

    @property
    def distortion_std(self) -> float:
        """Its standard deviation; inf where it is not observable, 0 where it was given."""
        return self.cameras[self.reference].distortion_std or 0.0

    @property
    def tilt(self) -> tuple[float, float] | None:
        """(ψ, θ) of the reference image, radians, shared by all (the mean one where it varies); None without."""
        return self.cameras[self.reference].tilt

    @property
    def focal(self) -> float | None:
        """Focal length in half diagonals; None where the model has none."""
        camera = self.cameras[self.reference]
        return None if camera.focal is None or "log_focal" not in self.parameters else camera.focal / camera.scale

    @property
    def focal_std(self) -> float | None:
        """Its standard deviation in the same unit."""
        camera = self.cameras[self.reference]
        return None if self.focal is None or camera.focal_std is None else camera.focal_std / camera.scale

    @property
    def lens_given(self) -> bool:
        """Whether λ was given, not estimated."""
        return self.cameras[self.reference].distortion_std is None

    @property
    def lens_observable(self) -> bool:
        """Whether λ was given, or the images show it."""
        return math.isfinite(self.distortion_std)

    @property
    def on_sphere(self) -> bool:
        """Whether :attr:`homographies` lead to directions around one centre, not to a plane."""
        return MODELS[self.model].on_sphere

    @property
    def length_std(self) -> float:
        """Relative standard deviation that all lengths on the plane share, that of the focal length; NaN without."""
        return math.nan if self.focal is None or self.focal_std is None else self.focal_std / self.focal

    @cached_property
    def support(self) -> dict[tuple[int, int], int]:
        """Number of inliers of every pair of images that the alignment uses."""
        return {(fit.image1, fit.image2): fit.inliers for fit in self.links if fit.used}

    @cached_property
    def holding(self) -> list[LinkFit]:
        """The links by which every image is where it is: those that are used, and those of copies that agree."""
        return [fit for fit in self.links if fit.used or (fit.reason is Unused.COPY and 2 * fit.inliers >= fit.count)]

    def transfer(self, image1: int, image2: int, points: FloatArray) -> FloatArray:
        """Where points (N, 2) of one image, pixels, are in another; NaN where its lens cannot see them."""
        if self.on_sphere:
            # what both images show may lie behind the plane that is before them.
            seen = to_plane(self.cameras[image1], self.relation(image1, image2), points)
            return from_plane(self.cameras[image2], np.eye(3), seen)
        plane = to_plane(self.cameras[image1], self.homographies[image1], points)
        return from_plane(self.cameras[image2], self.homographies[image2], plane)


def links_by_image(links: Iterable[LinkFit]) -> dict[int, list[LinkFit]]:
    """The links of each image that has any."""
    of_image: dict[int, list[LinkFit]] = {}
    for fit in links:
        for image in fit.images:
            of_image.setdefault(image, []).append(fit)
    return of_image
