"""Stitch images of a flat scene taken through a lens that bends straight lines, without knowing the lens.

Homography and division-model distortion λ are estimated together from the images themselves. The names below are
loaded when they are first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rdstitch import errors, solvers, synthetic
    from rdstitch.alignment import Alignment
    from rdstitch.alignment.trajectory import Trajectory
    from rdstitch.camera import Camera
    from rdstitch.camera_files import load_camera, save_camera
    from rdstitch.compositing import CompositeOptions
    from rdstitch.doctor import Examination, examine
    from rdstitch.errors import RdstitchError
    from rdstitch.features import FeatureOptions
    from rdstitch.messages import Message
    from rdstitch.options import StitchOptions
    from rdstitch.pipeline.apply_sidecar import apply
    from rdstitch.pipeline.composer import Composer
    from rdstitch.pipeline.follow import FollowedPoses, Pose, Tracker
    from rdstitch.pipeline.layers import write_layers
    from rdstitch.pipeline.recipes import calibrate, mosaic, mosaic_blocks, pano, trajectory
    from rdstitch.pipeline.recomposition import Recomposition
    from rdstitch.pipeline.stage_tiles import place_tiles, tiles
    from rdstitch.pipeline.undistort_images import undistort
    from rdstitch.radial_homography import RadialHomography
    from rdstitch.registration import Registration
    from rdstitch.report import write_report
    from rdstitch.robust import estimate_radial_homography
    from rdstitch.stage import TileOptions
    from rdstitch.stitch_result import StitchResult

    __version__: str

_HOMES = {
    name: home
    for home, names in {
        "rdstitch": "errors solvers synthetic",
        "rdstitch.alignment": "Alignment",
        "rdstitch.alignment.trajectory": "Trajectory",
        "rdstitch.camera": "Camera",
        "rdstitch.camera_files": "load_camera save_camera",
        "rdstitch.compositing": "CompositeOptions",
        "rdstitch.doctor": "Examination examine",
        "rdstitch.errors": "RdstitchError",
        "rdstitch.features": "FeatureOptions",
        "rdstitch.messages": "Message",
        "rdstitch.options": "StitchOptions",
        "rdstitch.pipeline.apply_sidecar": "apply",
        "rdstitch.pipeline.composer": "Composer",
        "rdstitch.pipeline.follow": "FollowedPoses Pose Tracker",
        "rdstitch.pipeline.layers": "write_layers",
        "rdstitch.pipeline.recipes": "calibrate mosaic mosaic_blocks pano trajectory",
        "rdstitch.pipeline.recomposition": "Recomposition",
        "rdstitch.pipeline.stage_tiles": "place_tiles tiles",
        "rdstitch.pipeline.undistort_images": "undistort",
        "rdstitch.radial_homography": "RadialHomography",
        "rdstitch.registration": "Registration",
        "rdstitch.report": "write_report",
        "rdstitch.robust": "estimate_radial_homography",
        "rdstitch.stage": "TileOptions",
        "rdstitch.stitch_result": "StitchResult",
    }.items()
    for name in names.split()
}

__all__ = [
    "Alignment",
    "Camera",
    "Composer",
    "CompositeOptions",
    "Examination",
    "FeatureOptions",
    "FollowedPoses",
    "Message",
    "Pose",
    "RadialHomography",
    "RdstitchError",
    "Recomposition",
    "Registration",
    "StitchOptions",
    "StitchResult",
    "TileOptions",
    "Tracker",
    "Trajectory",
    "apply",
    "calibrate",
    "errors",
    "estimate_radial_homography",
    "examine",
    "load_camera",
    "mosaic",
    "mosaic_blocks",
    "pano",
    "place_tiles",
    "save_camera",
    "solvers",
    "synthetic",
    "tiles",
    "trajectory",
    "undistort",
    "write_layers",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its home."""
    if name == "__version__":
        return import_module("importlib.metadata").version(__name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if _HOMES[name] == __name__:
        return import_module(f"{__name__}.{name}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return [*__all__, "__version__", "__doc__", "__all__"]
