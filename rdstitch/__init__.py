"""Stitch images of a flat scene taken through a lens that bends straight lines, without knowing the lens.

Homography and division-model distortion λ are estimated together from the images themselves. The names below are
loaded when they are first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import Any

# Names by the module that they live in; type checkers read the same in the stub.
_NAMES = {
    "": "errors solvers synthetic",
    "alignment": "Alignment",
    "camera_files": "load_camera save_camera",
    "errors": "RdstitchError",
    "export.layers": "write_layers",
    "geometry.camera": "Camera",
    "geometry.radial_homography": "RadialHomography",
    "options.apply_options": "ApplyOptions",
    "options.composite_options": "CompositeOptions",
    "options.feature_options": "FeatureOptions",
    "options.files_beside": "FilesBeside",
    "options.stitch_options": "StitchOptions",
    "options.tile_options": "TileOptions",
    "options.undistort_options": "UndistortOptions",
    "pipeline.apply_sidecar": "apply",
    "pipeline.blocks": "mosaic_blocks",
    "pipeline.composer": "Composer",
    "pipeline.doctor": "Examination examine",
    "pipeline.follow": "Tracker",
    "pipeline.recipes": "calibrate mosaic pano trajectory",
    "pipeline.stage_tiles": "place_tiles tiles",
    "pipeline.undistort_images": "undistort",
    "report": "write_report",
    "results.messages": "Message",
    "results.pose": "FollowedPoses Pose",
    "results.registration": "Registration",
    "results.stitch_result": "OutputImage StitchResult",
    "robust": "estimate_radial_homography",
    "sidecar.recomposition": "Recomposition",
    "trajectories.trajectory": "Trajectory",
}
_HOMES = {name: f"{__name__}.{home}".rstrip(".") for home, names in _NAMES.items() for name in names.split()}

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
