"""Options of the recipes: the same names and defaults as on the command line."""

import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, Self

from rdstitch.choices import CameraFormat, LensName, LocalAlignmentMode, ModelName
from rdstitch.errors import ArgumentError
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.options.estimation_options import EstimationOptions, RansacOptions
from rdstitch.options.feature_options import FeatureOptions
from rdstitch.options.option import Contradiction, Range, Unit, documented, option, reads, writes
from rdstitch.options.shared_options import CAMERA_FILE, ArrayChannels, Distortion, Mask, RunOptions
from rdstitch.system.machine import processor_count

if TYPE_CHECKING:
    from rdstitch.geometry.camera import Camera
    from rdstitch.inputs.odometry import Odometry

# Inliers from which on a free homography is as sure as a motion of the plane; the alignment decides between them.
_SELECT_MODEL_BELOW = 50

PREVIEW = {"seam": "voronoi", "max_features": 1500, "work_megapixels": 0.5, "max_size": 1200}
"""A quick draft: options of features and of the composite, by name."""


@documented
@dataclass(frozen=True)
class StitchOptions(RansacOptions, RunOptions):
    """How images are registered and composited.

    Raises :class:`rdstitch.errors.ArgumentError` where a value is out of range, unknown, or contradicts another one.
    A camera may also be given as the path of its file, or of a ROS bag with camera_info; a recipe reads it then.
    """

    contradictions: ClassVar[tuple[Contradiction, ...]] = (
        Contradiction(("lens",), ("distortion", "camera"), "the lens is known: leave out lens, or the known lens"),
        Contradiction(
            ("camera",),
            ("distortion",),
            "camera and distortion (--camera and --lambda) both say what the lens is; leave one of them out",
        ),
    )
    features: FeatureOptions = field(default_factory=FeatureOptions)
    ratio: float | None = option(
        None,
        "Largest ratio of the distances to the nearest and second nearest descriptor; None: what suits the features.",
        within=Range(above=0.0),
        flag=None,
    )
    lightglue_model: str | Path | None = reads("LightGlue network (ONNX) for these features.")
    lens: LensName = option(
        "auto", "Lens to estimate: λ; λ and the distortion centre; besides them a second or a third coefficient."
    )
    model: ModelName = option("auto", "Motion model of the camera.")
    camera: "Camera | str | Path | None" = reads(CAMERA_FILE)
    distortion: Distortion = None
    focal: float | None = option(
        None, "Focal length, pixels; otherwise from EXIF, or a guess.", "PX", within=Range(above=0.0)
    )
    tilt: tuple[float, float] | None = option(
        None,
        "Known tilt of the camera, {unit}; with --attitude, that of its mount, added to each.",
        "PSI,THETA",
        within=Range(above=-math.pi / 2, below=math.pi / 2),
        unit=Unit.RADIANS,
    )
    attitude: Literal["xmp"] | str | Path | None = reads(
        "Tilt of each image: CSV name,psi,theta in degrees; xmp: from the XMP of drone images.", "FILE|xmp"
    )
    attitude_std: float = option(
        math.radians(1.0),
        "Standard deviation of the attitudes, {unit}; 0 for exact ones.",
        "DEG",
        within=Range(least=0.0, most=math.pi / 2),
        unit=Unit.RADIANS,
        needs=("attitude",),
    )
    timestamps: str | Path | None = reads(
        "Time stamps of the images: CSV name,timestamp, lines TIME NAME, or a time a line; otherwise those of the "
        "video, bag or EXIF."
    )
    odometry: "Odometry | str | Path | None" = reads(
        "Wheel odometry, by time: TUM's lines, CSV timestamp,x,y,yaw_deg, or a topic of the bag. It gives the unit of "
        "positions, and poses of frames without texture.",
        "FILE|TOPIC",
    )
    positions: str | Path | None = reads(
        "Where images were taken, instead of EXIF: CSV name,lat,lon or name,x,y (see --crs), exiftool's -csv or "
        "-json, OpenDroneMap's geo.txt, or a GPX track."
    )
    positions_offset: float = option(
        0.0, "Seconds from the times of the images to those of the GPX track (UTC).", "S", needs=("positions",)
    )
    position_accuracy: float | None = option(
        None,
        "Standard deviation of a horizontal coordinate of positions that state none, metres.",
        "M",
        within=Range(above=0.0),
    )
    gcp: str | Path | None = reads(
        "Ground control points, as OpenDroneMap's gcp_list.txt, or CSV x,y,px,py,image,name,accuracy (see --crs); "
        "they bend the alignment, and place the output on the Earth."
    )
    check_points: str | Path | None = reads(
        "Points like those of --gcp that are compared with the map, and take no part in it."
    )
    mask: Mask = None
    channel_order: ArrayChannels = "bgr"
    exclude: tuple[str, ...] = option(
        (), "Exclude the image of this name, or all that match a pattern like 'img_49*'; repeatable.", "NAME"
    )
    include_only: tuple[str, ...] = option((), "Use only the images of this name or pattern; repeatable.", "NAME")
    reference: str | None = option(None, "Reference image; otherwise the best connected one.", "NAME")
    pose_covariance: bool = option(
        False, "Compute covariances of the poses, for the sidecar and tables of poses.", flag=None
    )
    local_alignment: LocalAlignmentMode = option(
        "auto",
        "Smooth displacement of each image where the scene has depth. auto: if held-out matches come nearer; N: "
        "always, with N cells along an image's longer side.",
        "auto|off|N",
        within=Range(least=2, most=100),
    )
    composite: CompositeOptions = field(default_factory=CompositeOptions)
    cache: Path | None = option(
        None, "Folder for features, pairs and alignments, to reuse in later runs; made if missing.", "DIR"
    )
    scheduler: str | None = option(
        None,
        "Run on a Dask cluster that shares the images and the folder of --cache; local starts one here.",
        "ADDRESS|local",
    )
    force: bool = option(False, "Write the result even when it fails its own checks.")
    save_camera: Path | None = writes("Write the estimated camera.")
    camera_format: CameraFormat = option(
        "auto",
        "Format of the camera file written. auto: by its name, .json (rdstitch), .yml (OpenCV), .fisheye.yml, "
        ".pto (Hugin), .xml (lensfun), cameras.json (OpenDroneMap), cameras.txt (COLMAP), camera_info.yaml (ROS), "
        "camchain.yaml (Kalibr).",
        needs=("save_camera",),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.solver == "two_point" and self.tilt is None and (self.attitude is None or self.attitude_std > 0.0):
            raise ArgumentError("the two_point solver needs the tilt, or exact attitudes")
        if self.distortion is not None or self.camera is not None:
            self.refuse_solver()
        if self.scheduler not in (None, "local") and self.cache is None:
            raise ArgumentError("a cluster needs a folder for features that all its machines see: give --cache too")
        if self.composite.measured and self.reference is None:
            raise ArgumentError("rectangle and lines are pixels of the reference image: say which, give reference too")

    def for_images(self, count: int) -> Self:
        """The same with numbers for what depends on how many images there are."""
        return replace(self, features=self.features.for_images(count))

    @property
    def known_camera(self) -> "Camera | None":
        """The camera that was given, which the recipe has read where it was a file."""
        if isinstance(self.camera, str | Path):
            raise ArgumentError(f"{self.camera}: has not been read yet; give rdstitch.load_camera of it")
        return self.camera

    @property
    def known_distortion(self) -> float | None:
        """λ where the user gave it, or of the camera given; of a richer lens, the nearest one-parameter λ."""
        if self.distortion is not None or self.known_camera is None:
            return self.distortion
        return self.known_camera.nearest_distortion

    @property
    def estimation(self) -> EstimationOptions:
        """How pairs are estimated."""
        search = {each.name: getattr(self, each.name) for each in fields(RansacOptions)}
        return EstimationOptions(**search, distortion=self.known_distortion, select_below=_SELECT_MODEL_BELOW)

    @property
    def compositing(self) -> CompositeOptions:
        """Options of the compositor, which works on as many tiles at a time."""
        return replace(self.composite, workers=self.composite.workers or self.threads)

    @property
    def threads(self) -> int:
        """Number of images or pairs to work on at the same time."""
        return self.workers or processor_count()
