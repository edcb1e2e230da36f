"""Options of the recipes: the same names and defaults as on the command line."""

import math
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

from rdstitch.alignment import LENSES, MODELS
from rdstitch.choices import CameraFormat, LensName, ModelName, SolverName
from rdstitch.compositing import CompositeOptions
from rdstitch.errors import ArgumentError
from rdstitch.executors import LOCAL, open_executor
from rdstitch.features import FeatureOptions
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.frame import ChannelOrder
from rdstitch.inputs.rosbag import camera_in
from rdstitch.local_alignment import MAX_CELLS, LocalAlignmentMode
from rdstitch.robust import SOLVERS, EstimationOptions
from rdstitch.system.machine import processor_count

_SELECT_MODEL_BELOW = 50
"""Inliers from which on a free homography is as sure as a motion of the plane; the alignment decides between them."""

_MAX_WORKERS = 1024  # threads; more than any machine has cores for
_MAX_THRESHOLD = 1e4  # pixels; more than an image is wide


@dataclass(frozen=True)
class StitchOptions:
    """How images are registered and composited.

    Attributes
    ----------
    features : FeatureOptions
        Which features are detected.
    ratio : float, optional
        Largest ratio of the distances to the nearest and second nearest descriptor; None: what suits the features.
    lightglue_model : path, optional
        ONNX file of a network that matches the features instead.
    solver : str
        Minimal solver of the pairs: "auto", "two_point", "three_point", "three_point_similarity", "four_point" or
        "five_point".
    lens : str
        Lens model, one of ``rdstitch.alignment.LENSES``; "auto": the simplest that the images allow.
    model : str
        Motion model of the whole, one of ``rdstitch.alignment.MODELS``; "auto": the least free that the images allow.
    threshold : float
        Largest transfer error of an inlier, pixels of the size that features are detected at.
    confidence : float
        Probability that no better model of a pair was missed.
    max_iterations : int
        Samples per pair.
    camera : Camera, or path of a camera file or of a ROS bag with camera_info, optional
        Known camera: its λ is kept, its focal length trusted.
    distortion : float, optional
        Known λ, in the half-diagonal frame; it is kept.
    focal : float, optional
        Known focal length, pixels.
    tilt : (float, float), optional
        Known tilt (psi, theta) of all images, radians.
    attitude : path, optional
        Measured tilt of each image: CSV of name, psi, theta, degrees; or "xmp".
    attitude_std : float
        Standard deviation of these tilts, radians; 0: exact.
    timestamps : path, optional
        Times of the images, see :func:`rdstitch.inputs.sensor_streams.with_times`; otherwise those of the video, the
        bag, or EXIF.
    positions : path, optional
        Positions of the images instead of those of EXIF; see :mod:`rdstitch.inputs.positions`. Their x and y are in the
        system of ``composite.epsg``.
    positions_offset : float
        Seconds to add to the images' times for those of a GPX track, which are in UTC.
    gcp : path, optional
        Ground control points, as OpenDroneMap's ``gcp_list.txt``: they alone place the output on the Earth.
    check_points : path, optional
        Points in the same format that are compared with the map, and take no part in it.
    mask : path, optional
        Image, or folder of them, that is dark where the images do not count.
    channel_order : str
        Order of the channels of arrays that come in or go out: "bgr", as OpenCV has it, or "rgb".
    exclude, include_only : tuple of str
        Names, or patterns with ``*``, ``?`` and ``[...]``, of images that are not used, and of those that alone are
        used; empty for all.
    topic : str, optional
        Topic of the images in ROS bags; None: the only one.
    reference : str, optional
        Name of the image whose frame is kept; None: the best connected.
    pose_covariance : bool
        Compute covariances of the poses, for the sidecar and tables of poses.
    local_alignment : "auto", "off" or int
        Smooth displacements of the images where the ground is rough: where held-out matches come nearer by them,
        never, or always, with so many cells along the longer side of an image.
    composite : CompositeOptions
        How the images are put together.
    cache : path, optional
        Folder of results of earlier runs, to continue from; made if missing.
    seed : int
        Seed of random sampling: the same gives the same result, bit for bit.
    workers : int
        Images and pairs worked on at the same time; 0: as many as there are cores.
    scheduler : str, optional
        Address of the scheduler of a Dask cluster that does the work, or "local" for one on this machine; needs the
        extra ``distributed``. A cluster also needs ``cache``, a folder that all its machines see by the same name, as
        they must see the images.
    overwrite : bool
        Replace existing outputs.
    strict : bool
        Fail when an image is left out.
    force : bool
        Write the image even when the result failed its checks.
    save_camera : path, optional
        Camera file to write.
    camera_format : str
        Its format, see :mod:`rdstitch.camera_files`; "auto": what its name says.
    dry_run : bool
        Register and plan the compositing; write nothing.

    Raises
    ------
    ArgumentError
        When a value is out of range, unknown, or contradicts another one.
    """

    features: FeatureOptions = field(default_factory=FeatureOptions)
    ratio: float | None = None
    lightglue_model: str | Path | None = None
    solver: SolverName = "auto"
    lens: LensName = "auto"
    model: ModelName = "auto"
    threshold: float = 3.0
    confidence: float = 0.999
    max_iterations: int = 10000
    camera: Camera | None = None  # a path, given instead, is read
    distortion: float | None = None
    focal: float | None = None
    tilt: tuple[float, float] | None = None
    attitude: str | Path | None = None
    attitude_std: float = math.radians(1.0)
    timestamps: str | Path | None = None
    positions: str | Path | None = None
    positions_offset: float = 0.0
    gcp: str | Path | None = None
    check_points: str | Path | None = None
    mask: str | Path | None = None
    channel_order: ChannelOrder = "bgr"
    exclude: tuple[str, ...] = ()
    include_only: tuple[str, ...] = ()
    topic: str | None = None
    reference: str | None = None
    pose_covariance: bool = False
    local_alignment: LocalAlignmentMode = "auto"
    composite: CompositeOptions = field(default_factory=CompositeOptions)
    cache: Path | None = None
    seed: int = 0
    workers: int = 0
    scheduler: str | None = None
    overwrite: bool = False
    strict: bool = False
    force: bool = False
    save_camera: Path | None = None
    camera_format: CameraFormat = "auto"
    dry_run: bool = False

    def __post_init__(self) -> None:
        for name, convert in (("cache", Path), ("save_camera", Path), ("camera", camera_in)):
            # Text is as good as a path, as it is for images.
            if isinstance(given := getattr(self, name), str | Path):
                object.__setattr__(self, name, convert(given))
        for name, angles in (("tilt", self.tilt or ()), ("attitude_std", (self.attitude_std,))):
            if not all(abs(angle) <= math.pi / 2 for angle in angles):
                raise ArgumentError(f"{name} is in radians, and at most pi/2, not {angles}; use math.radians")
        if self.solver not in SOLVERS:
            raise ArgumentError(f"unknown solver {self.solver!r}; choose one of {', '.join(SOLVERS)}")
        if self.model not in ("auto", *MODELS):
            raise ArgumentError(f"unknown model {self.model!r}; choose one of auto, {', '.join(MODELS)}")
        if self.lens not in ("auto", *LENSES):
            raise ArgumentError(f"unknown lens {self.lens!r}; choose one of auto, {', '.join(LENSES)}")
        if self.lens != "auto" and self.known_distortion is not None:
            raise ArgumentError("the lens is known: leave out lens, or the known lens")
        if self.solver == "two_point" and self.tilt is None and (self.attitude is None or self.attitude_std > 0.0):
            raise ArgumentError("the two_point solver needs the tilt, or exact attitudes")
        if self.solver != "auto" and self.known_distortion is not None:
            raise ArgumentError("with a known λ no solver can be chosen")
        if self.distortion is not None and not -1.0 < self.distortion < 1.0:
            raise ArgumentError(f"λ must lie between -1 and 1, not {self.distortion}")
        if self.focal is not None and not 0.0 < self.focal < float("inf"):
            raise ArgumentError(f"the focal length must be positive, not {self.focal}")
        if not 0.0 <= self.attitude_std < float("inf"):
            raise ArgumentError(f"the standard deviation of attitudes must not be negative, not {self.attitude_std}")
        if not math.isfinite(self.positions_offset):
            raise ArgumentError(f"positions_offset must be seconds, not {self.positions_offset}")
        if not self.threshold > 0.0 or not 0.0 < self.confidence < 1.0 or self.max_iterations < 1:
            raise ArgumentError("threshold and max_iterations must be positive, confidence between 0 and 1")
        if not self.threshold <= _MAX_THRESHOLD:
            raise ArgumentError(f"the threshold of an inlier must be at most {_MAX_THRESHOLD:g} pixels")
        if isinstance(self.local_alignment, int) and not 2 <= self.local_alignment <= MAX_CELLS:
            raise ArgumentError(f"local_alignment has from 2 to {MAX_CELLS} cells, not {self.local_alignment}")
        if isinstance(self.local_alignment, str) and self.local_alignment not in ("auto", "off"):
            raise ArgumentError(f"local_alignment is auto, off or a number of cells, not {self.local_alignment!r}")
        if self.scheduler not in (None, LOCAL) and self.cache is None:
            raise ArgumentError("a cluster needs a folder for features that all its machines see: give --cache too")
        if self.composite.measured and self.reference is None:
            raise ArgumentError("rectangle and lines are pixels of the reference image: say which, give reference too")
        if self.workers < 0 or self.seed < 0:
            raise ArgumentError("workers and seed must not be negative")
        if self.workers > _MAX_WORKERS:
            raise ArgumentError(f"workers must be at most {_MAX_WORKERS}, not {self.workers}")

    def for_images(self, count: int) -> Self:
        """The same with numbers for what depends on how many images there are."""
        return replace(self, features=self.features.for_images(count))

    @property
    def known_distortion(self) -> float | None:
        """λ where the user gave it, alone or with the camera; of a richer lens, the nearest one-parameter λ."""
        if self.distortion is not None or self.camera is None:
            return self.distortion
        return self.camera.nearest_distortion

    @property
    def files(self) -> list[Path]:
        """The files that are read besides the images, none of which may be written over."""
        named = (
            self.mask,
            self.attitude,
            self.timestamps,
            self.positions,
            self.gcp,
            self.check_points,
            self.lightglue_model,
            self.features.aliked_model,
            self.composite.like,
        )
        given = [Path(file) for file in named if file is not None]
        return [file for path in given for file in (sorted(path.iterdir()) if path.is_dir() else [path])]

    @property
    def estimation(self) -> EstimationOptions:
        """How pairs are estimated."""
        return EstimationOptions(
            self.solver,
            self.known_distortion,
            self.threshold,
            self.confidence,
            self.max_iterations,
            self.seed,
            _SELECT_MODEL_BELOW,
        )

    def executor(self, images: int) -> Executor:
        """Give where the tasks of a set of so many images are computed; to be used in a ``with`` block."""
        return open_executor(self.threads, images, scheduler=self.scheduler, store=self.cache)

    @property
    def threads(self) -> int:
        """Number of images or pairs to work on at the same time."""
        return self.workers or processor_count()
