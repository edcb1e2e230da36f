"""Words that the user chooses among, each list once: for types, for checks, and for help, which loads nothing large."""

from enum import StrEnum
from typing import Literal, get_args

FeatureName = Literal["rootsift", "sift", "surf", "orb", "akaze", "aliked"]
SolverName = Literal["auto", "two_point", "three_point", "three_point_similarity", "four_point", "five_point"]
LensName = Literal["auto", "division", "division-center", "division2", "division3"]
ModelName = Literal["auto", "rigid", "similarity", "tilting", "pose", "homography", "rotation"]
CameraFormat = Literal[
    "auto",
    "rdstitch",
    "opencv",
    "opencv-json",
    "fisheye",
    "ros",
    "kalibr",
    "colmap",
    "opendronemap",
    "hugin",
    "lensfun",
]
FocalSource = Literal["option", "file", "exif", "estimate", "guess"]  # where a focal length comes from
ProjectionName = Literal["auto", "plane", "cylinder", "sphere", "mercator", "panini", "stereographic"]
ChannelOrder = Literal["bgr", "rgb"]  # of arrays that come in or go out; OpenCV has the first
ScanOrder = Literal["rows", "columns", "snake-rows", "snake-columns"]
Origin = Literal["top-left", "top-right", "bottom-left", "bottom-right"]
ZPlane = int | Literal["max"]
LocalAlignmentMode = Literal["auto", "off"] | int  # the number of cells along an image's longer side
PosesFrame = Literal["enu", "ros", "camera", "first", "map"]
TrajectoryFormat = Literal["auto", "csv", "tum", "kitti", "bag"]
TrajectoryFrame = Literal["enu", "camera", "ros", "first"]
MatchBy = Literal["auto", "name", "order"]
Framing = Literal["same", "all", "valid"]
ImageFormat = Literal["jpg", "png", "tif", "webp"]

SOLVERS: tuple[SolverName, ...] = get_args(SolverName)


class Purpose(StrEnum):
    """The recipe that a registration is for."""

    PANO = "pano"  # a turn on the spot is taken where a plane explains the images as well
    MOSAIC = "mosaic"
    CALIBRATE = "calibrate"
    TRAJECTORY = "trajectory"

    @property
    def picture(self) -> bool:
        """Whether a picture is wanted, which its seams judge: it must be possible to lay it out; λ may be anything."""
        return self in (Purpose.PANO, Purpose.MOSAIC)

    @property
    def lens_only(self) -> bool:
        """Whether only the lens is wanted: images may be off by periods of a pattern, places do not matter."""
        return self is Purpose.CALIBRATE

    @property
    def poses(self) -> bool:
        """Whether poses must be metric, so that the freest model is that of planar motion with small tilts."""
        return self is Purpose.TRAJECTORY

    @property
    def unknown_lens(self) -> Literal["detail", "warning", "failure"]:
        """How grave it is that λ is unknown: a path can be right by what is known of the lens."""
        return "detail" if self.picture else "failure" if self.lens_only else "warning"
