"""Stitch pictures of a flat scene taken through a lens that bends straight lines, without knowing the lens.

Homography and division-model distortion λ are estimated together from the pictures themselves. The names below are
loaded when they are first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rdstitch import solvers
    from rdstitch.camera import Camera
    from rdstitch.camera_files import load_camera, save_camera
    from rdstitch.compositing import CompositeOptions
    from rdstitch.features import FeatureOptions
    from rdstitch.pipeline import (
        Recomposition,
        StitchOptions,
        StitchResult,
        apply,
        calibrate,
        mosaic,
        pano,
        trajectory,
        undistort,
    )
    from rdstitch.radial_homography import RadialHomography
    from rdstitch.report import write_report
    from rdstitch.robust import estimate_radial_homography

_HOMES = {
    "Camera": "rdstitch.camera",
    "CompositeOptions": "rdstitch.compositing",
    "FeatureOptions": "rdstitch.features",
    "RadialHomography": "rdstitch.radial_homography",
    "Recomposition": "rdstitch.pipeline",
    "StitchOptions": "rdstitch.pipeline",
    "StitchResult": "rdstitch.pipeline",
    "estimate_radial_homography": "rdstitch.robust",
    "apply": "rdstitch.pipeline",
    "load_camera": "rdstitch.camera_files",
    "save_camera": "rdstitch.camera_files",
    "calibrate": "rdstitch.pipeline",
    "mosaic": "rdstitch.pipeline",
    "pano": "rdstitch.pipeline",
    "trajectory": "rdstitch.pipeline",
    "solvers": "rdstitch",
    "undistort": "rdstitch.pipeline",
    "write_report": "rdstitch.report",
}

__all__ = [
    "Camera",
    "CompositeOptions",
    "FeatureOptions",
    "RadialHomography",
    "Recomposition",
    "StitchOptions",
    "StitchResult",
    "apply",
    "calibrate",
    "estimate_radial_homography",
    "load_camera",
    "mosaic",
    "pano",
    "save_camera",
    "solvers",
    "trajectory",
    "undistort",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its home."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if _HOMES[name] == __name__:
        return import_module(f"{__name__}.{name}")
    return getattr(import_module(_HOMES[name]), name)
