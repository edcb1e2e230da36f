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

FEATURES: tuple[str, ...] = get_args(FeatureName)
SOLVERS: tuple[SolverName, ...] = get_args(SolverName)
