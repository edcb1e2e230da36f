"""Words that the user chooses among, each list once: for types, for checks, and for help, which loads nothing large."""

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
ProjectionName = Literal["auto", "plane", "cylinder", "sphere", "mercator", "panini", "stereographic"]
ChannelOrder = Literal["bgr", "rgb"]  # of arrays that come in or go out; OpenCV has the first
ScanOrder = Literal["rows", "columns", "snake-rows", "snake-columns"]
Origin = Literal["top-left", "top-right", "bottom-left", "bottom-right"]
ZPlane = int | Literal["max"]
LocalAlignmentMode = Literal["auto", "off"] | int  # the number of cells along an image's longer side
PosesFrame = Literal["enu", "ros", "camera", "map"]
TrajectoryFormat = Literal["csv", "tum", "kitti", "bag"]
TrajectoryFrame = Literal["enu", "camera", "ros"]
MatchBy = Literal["auto", "name", "order"]
Framing = Literal["same", "all", "valid"]
ImageFormat = Literal["jpg", "png", "tif", "webp"]

SOLVERS: tuple[SolverName, ...] = get_args(SolverName)

Purpose = Literal["pano", "mosaic", "calibrate", "trajectory"]
"""The recipe that a registration is for. In "pano" every image must be readable, and a turn on the spot is taken where
a plane explains the images as well; for "calibrate" images of a repeated pattern may be off by whole periods of it, and
doubts about their places do not matter; for "trajectory" poses must be metric, so that the freest model is that of
planar motion with small tilts."""
