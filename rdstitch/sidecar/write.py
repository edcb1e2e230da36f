"""The sidecar: everything that was estimated, as JSON beside the image."""

import dataclasses
import math
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.compositing import Canvas, SeamQuality
from rdstitch.compositing.panorama_canvas import center_of_view, field_of_view
from rdstitch.compositing.projection import PLANE
from rdstitch.export.georeference import Georeference, Residual
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.source import Source
from rdstitch.local_alignment import DisplacementField
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.outputs import Fingerprint

VERSION = 2
"""Version 1 had no more of a lens than λ and μ, as ``lambda`` and ``lambda2``."""


def sidecar(result: StitchResult) -> dict[str, Any]:
    """The sidecar's content; every number that does not exist is null.

    ``lambda`` is for half the image diagonal. ``images[].to_plane`` maps undistorted, half-diagonal-normalized
    coordinates of an image to the plane, or to directions where the camera turned on the spot,
    ``output.plane_to_output`` places of the plane, or of the projection, to pixels of the output;
    ``images[].to_output`` is the product, on a plane; ``pairs[].homography`` maps coordinates of the first image
    to those of the second. All fields are described in docs/formats.md.
    """
    registration, alignment = result.registration, result.registration.alignment
    camera, local = registration.camera, result.local_alignment
    content = {
        "format": "rdstitch sidecar",
        "version": VERSION,
        "lambda": alignment.distortion,
        "lambda_std": alignment.distortion_std,
        "lambda_px": camera.distortion_px,
        "lambda_focal": camera.distortion_focal,
        "lambda_known": alignment.lens_given,
        "lens": alignment.lens,
        "lens_reason": alignment.lens_reason,
        "camera": camera.as_dict(),
        "tilt_deg": None if alignment.tilt is None else np.degrees(alignment.tilt),
        "focal_px": camera.focal,
        "focal_source": camera.focal_source,
        "model": alignment.model,
        "model_reason": alignment.model_reason,
        "rms_px": alignment.rms,
        "reference": registration.sources[alignment.reference].name,
        "output": {
            **identity_fields(result.output, result.fingerprint),
            **output_geometry(result.canvas, turned=alignment.on_sphere),
            "georeference": georeference_fields(result.georeference, result.not_georeferenced),
        },
        # The displacements are with their images.
        "local_alignment": {
            "used": bool(local.fields),
            "reason": local.reason,
            "cells": local.cells,
            "held_out_px": {"before": local.before, "after": local.after},
        },
        "seams": seams_fields(result.seams, registration.used_names),
        "stage": _stage(registration),
        "images": _images(result),
        "pairs": _pairs(result),
        "verdict": {**dataclasses.asdict(result.verdict), "relief": alignment.relief},
        "options": result.options,
        "seed": result.options.seed,
        "versions": versions(),
    }
    return {key: plain(value) for key, value in content.items()}


def _images(result: StitchResult) -> list[dict[str, Any]]:
    registration, alignment = result.registration, result.registration.alignment
    reasons = {Path(missing.images[0]): missing.text for missing in registration.left_out}
    entries = []
    fields = iter(result.local_alignment.fields)
    for index, source in enumerate(registration.sources):
        used, poses = bool(alignment.used[index]), alignment.poses
        entry: dict[str, Any] = {
            "name": source.name,
            "path": str(source.path),
            "size": source.camera.image_size,
            "used": used,
            "reason": reasons.pop(source.path, ""),
            "features": registration.keypoints[index],
            **lens_fields(alignment.cameras[index]),
            "to_plane": alignment.homographies[index] if used else None,
            "to_output": to_output(result.canvas, alignment.homographies[index]) if used else None,
            "displacement": displacement(next(fields, None) if used else None),
            "pose": None,
            **taken_fields(source),
        }
        if used and poses is not None:
            entry["pose"] = {
                "x": poses.position[index, 0],
                "y": poses.position[index, 1],
                "height": poses.height[index],
                "yaw_deg": np.degrees(poses.yaw[index]),
                "tilt_deg": np.degrees(poses.tilt[index]),
                "covariance": None if poses.covariance is None else poses.covariance[index],
            }
        entries.append(entry)
    unread = [
        {"name": path.name, "path": str(path), "size": None, "used": False, "reason": reason, "pose": None}
        for path, reason in reasons.items()
    ]
    return entries + unread


def taken_fields(source: Source) -> dict[str, Any]:
    """Give when and where an image was taken."""
    gps = source.metadata.gps
    return {
        "timestamp": source.metadata.timestamp,
        "gps": None if gps is None else (gps.latitude, gps.longitude, gps.altitude),
    }


def output_geometry(canvas: Canvas, *, turned: bool) -> dict[str, Any]:
    """Size and projection of the output; its view, where the camera turned on the spot."""
    return {
        "size": canvas.size,
        "plane_to_output": canvas.matrix,
        "projection": canvas.projection.name,
        "orientation": canvas.orientation,
        "wraps_around": canvas.period is not None,
        "field_of_view_deg": np.degrees(field_of_view(canvas)) if turned else None,
        "center_deg": np.degrees(center_of_view(canvas)) if turned else None,
    }


def seams_fields(seams: SeamQuality, names: Sequence[str]) -> dict[str, Any]:
    """Where the seams between images of these names hold and where they break."""
    breaks = [
        {
            "images": [names[k] for k in one.images],
            "x": one.position[0],
            "y": one.position[1],
            "length_px": one.length,
            "shift_px": one.size,
        }
        for one in seams.breaks
    ]
    return {"places": len(seams.places), "broken": int(seams.broken.sum()), "breaks": breaks}


def georeference_fields(place: Georeference | None, reason: str) -> dict[str, Any]:
    """Give where the output lies on the Earth, by what; or why that is not known."""
    if place is None:
        return {"reason": reason}
    return {
        "crs": f"EPSG:{place.crs.epsg}",
        "gsd_m": place.gsd,
        "pixel_to_map": place.pixel_to_map,
        "north_up": place.north_up,
        "source": place.source,
        "positions": len(place.residuals),
        "positions_used": place.used,
        "rms_m": place.rms,
        "std_m": place.std,
        "residuals": _residuals(place.residuals),
        "check_points": _residuals(place.checks),
    }


def _residuals(residuals: Sequence[Residual]) -> list[dict[str, Any]]:
    return [{"name": one.name, "east_m": one.east, "north_m": one.north, "used": one.used} for one in residuals]


def to_output(canvas: Canvas, homography: FloatArray) -> FloatArray | None:
    """From undistorted coordinates to pixels of the output, where one matrix can say that: on a plane."""
    return canvas.matrix @ homography if canvas.projection == PLANE else None


def identity_fields(output: Path | None, written: Fingerprint | None) -> dict[str, Any]:
    """Give what the sidecar belongs to; by size and digest a reader sees whether it still does."""
    return {
        "file": None if output is None else output.name,
        "bytes": None if written is None else written.size,
        "sha256": None if written is None else written.sha256,
    }


def _stage(registration: Registration) -> dict[str, Any] | None:
    """Give what the stage does, and which tiles have their places from it alone; None where the images are no tiles."""
    if registration.tiles is None:
        return None
    grid, model = registration.tiles.grid, registration.tiles.adjustment.stage
    # Whole pixels are another source of error.
    stds = np.hypot(registration.tiles.stds, 0.0 if registration.alignment.distortion else math.sqrt(1.0 / 12.0))
    lines = zip(registration.sources, grid.rows, grid.columns, registration.tiles.linked, stds, strict=True)
    return {
        "source": grid.source,
        "pixel_um": grid.pixel_size,
        "z": registration.tiles.z,
        "time": registration.tiles.time,
        "matrix": model.matrix,
        "rows_px": model.rows,
        "columns_px": model.columns,
        "row_std_px": model.row_std,
        "column_std_px": model.column_std,
        "tile_std_px": model.std,
        "tiles": [
            {
                "name": source.name,
                "row": row,
                "column": column,
                "placed_by": "overlap" if linked else "stage",
                "std_px": std,
            }
            for source, row, column, linked, std in lines
        ],
    }


def displacement(field: DisplacementField | None) -> dict[str, Any] | None:
    """Displacement of one image: columns and rows of its grid, and pixels at its nodes, row by row."""
    if field is None:
        return None
    rows, columns, _ = field.values.shape
    return {"grid": (columns, rows), "px": field.values.reshape(-1, 2)}


def lens_fields(camera: Camera) -> dict[str, Any]:
    """Give what of an image's camera depends on the size of the image, and λ with it."""
    return {
        "center_px": camera.center,
        "image_circle_px": camera.image_circle,
        "lambda": camera.nearest_distortion,
        "coefficients": camera.coefficients,
        "lens_model": None if camera.lens_model is None else dataclasses.asdict(camera.lens_model),
        "focal_px": camera.focal,
        "focal_source": camera.focal_source,
    }


def _pairs(result: StitchResult) -> list[dict[str, Any]]:
    registration = result.registration
    fits = {(fit.image1, fit.image2): fit for fit in registration.alignment.links}
    names = [source.name for source in registration.sources]
    entries = []
    for pair in registration.pairs:
        relation, fit = pair.relation, fits.get((pair.image1, pair.image2))
        entries.append(
            {
                "images": [names[pair.image1], names[pair.image2]],
                "matches": len(pair.matches),
                "inliers": int(relation.inliers.sum()),
                "rms_px": relation.rms,
                "lambda": relation.distortion,
                "lambda_std": relation.distortion_std if relation.ok else None,
                "model": relation.model or None,
                "homography": relation.homography if relation.ok else None,
                "solver": relation.solver or None,
                "iterations": relation.iterations,
                "ok": relation.ok,
                "reason": relation.reason,
                "used": fit is not None and fit.used,
                "dropped": fit.reason if fit is not None else "",
                "inliers_of_whole": fit.inliers if fit is not None else None,
                "rms_of_whole_px": fit.rms if fit is not None else None,
            }
        )
    return entries


def versions() -> dict[str, str]:
    """Versions of what has a say in the result."""
    from importlib.metadata import version

    import scipy

    return {
        "rdstitch": version("rdstitch"),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        # Whichever of its wheels is installed.
        "opencv": cv2.__version__,
        "python": platform.python_version(),
    }


def plain(value: Any) -> Any:
    """Plain JSON values: arrays to lists, dataclasses to objects, paths to text, what is not finite to null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
