"""Stitch images of a flat scene taken through a lens that bends straight lines, without knowing the lens.

Homography and division-model distortion λ are estimated together from the images themselves. The names below are
loaded when they are first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rdstitch import errors as errors
    from rdstitch import solvers as solvers
    from rdstitch import synthetic as synthetic
    from rdstitch.alignment import Alignment as Alignment
    from rdstitch.alignment.trajectory import Trajectory as Trajectory
    from rdstitch.camera_files import load_camera as load_camera
    from rdstitch.camera_files import save_camera as save_camera
    from rdstitch.errors import RdstitchError as RdstitchError
    from rdstitch.export.layers import write_layers as write_layers
    from rdstitch.geometry.camera import Camera as Camera
    from rdstitch.geometry.radial_homography import RadialHomography as RadialHomography
    from rdstitch.options.apply_options import ApplyOptions as ApplyOptions
    from rdstitch.options.composite_options import CompositeOptions as CompositeOptions
    from rdstitch.options.feature_options import FeatureOptions as FeatureOptions
    from rdstitch.options.files_beside import FilesBeside as FilesBeside
    from rdstitch.options.stitch_options import StitchOptions as StitchOptions
    from rdstitch.options.tile_options import TileOptions as TileOptions
    from rdstitch.pipeline.apply_sidecar import apply as apply
    from rdstitch.pipeline.blocks import mosaic_blocks as mosaic_blocks
    from rdstitch.pipeline.composer import Composer as Composer
    from rdstitch.pipeline.doctor import Examination as Examination
    from rdstitch.pipeline.doctor import examine as examine
    from rdstitch.pipeline.follow import Tracker as Tracker
    from rdstitch.pipeline.recipes import calibrate as calibrate
    from rdstitch.pipeline.recipes import mosaic as mosaic
    from rdstitch.pipeline.recipes import pano as pano
    from rdstitch.pipeline.recipes import trajectory as trajectory
    from rdstitch.pipeline.stage_tiles import place_tiles as place_tiles
    from rdstitch.pipeline.stage_tiles import tiles as tiles
    from rdstitch.pipeline.undistort_images import undistort as undistort
    from rdstitch.report import write_report as write_report
    from rdstitch.results.messages import Message as Message
    from rdstitch.results.pose import FollowedPoses as FollowedPoses
    from rdstitch.results.pose import Pose as Pose
    from rdstitch.results.registration import Registration as Registration
    from rdstitch.results.stitch_result import StitchResult as StitchResult
    from rdstitch.robust import estimate_radial_homography as estimate_radial_homography
    from rdstitch.sidecar.recomposition import Recomposition as Recomposition

    __version__: str

_HOMES = {
    name: home
    for home, names in {
        "rdstitch": "errors solvers synthetic",
        "rdstitch.alignment": "Alignment",
        "rdstitch.alignment.trajectory": "Trajectory",
        "rdstitch.geometry.camera": "Camera",
        "rdstitch.camera_files": "load_camera save_camera",
        "rdstitch.options.composite_options": "CompositeOptions",
        "rdstitch.pipeline.doctor": "Examination examine",
        "rdstitch.errors": "RdstitchError",
        "rdstitch.options.feature_options": "FeatureOptions",
        "rdstitch.results.messages": "Message",
        "rdstitch.options.stitch_options": "StitchOptions",
        "rdstitch.pipeline.apply_sidecar": "apply",
        "rdstitch.sidecar.recomposition": "Recomposition",
        "rdstitch.pipeline.composer": "Composer",
        "rdstitch.pipeline.follow": "Tracker",
        "rdstitch.results.pose": "FollowedPoses Pose",
        "rdstitch.options.files_beside": "FilesBeside",
        "rdstitch.export.layers": "write_layers",
        "rdstitch.pipeline.blocks": "mosaic_blocks",
        "rdstitch.pipeline.recipes": "calibrate mosaic pano trajectory",
        "rdstitch.pipeline.stage_tiles": "place_tiles tiles",
        "rdstitch.pipeline.undistort_images": "undistort",
        "rdstitch.geometry.radial_homography": "RadialHomography",
        "rdstitch.results.registration": "Registration",
        "rdstitch.report": "write_report",
        "rdstitch.robust": "estimate_radial_homography",
        "rdstitch.options.apply_options": "ApplyOptions",
        "rdstitch.options.tile_options": "TileOptions",
        "rdstitch.results.stitch_result": "StitchResult",
    }.items()
    for name in names.split()
}

__all__ = [*_HOMES]


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
