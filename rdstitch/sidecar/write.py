"""The sidecar: everything that was estimated, as JSON beside the image."""

import dataclasses
import math
from pathlib import Path
from typing import Any, cast

import numpy as np

from rdstitch.geometry.camera_record import camera_record, lens_fields
from rdstitch.matching.two_view import PairRegistration
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.sidecar.parts import (
    displacement_record,
    in_degrees,
    output_record,
    recorded_path,
    seams_record,
    taken_fields,
    to_lists,
    to_output,
    versions,
)
from rdstitch.sidecar.records import (
    VERSION,
    BeforeAfter,
    ImageRecord,
    Lens,
    LocalAlignmentRecord,
    Model,
    PairRecord,
    PoseRecord,
    ReliefRecord,
    SidecarRecord,
    StageRecord,
    TileRecord,
    VerdictRecord,
)
from rdstitch.system.records import to_jsonable


def sidecar(result: StitchResult) -> dict[str, Any]:
    """The sidecar's content, as docs/formats.md describes it; every number that does not exist is null."""
    registration, alignment = result.registration, result.registration.alignment
    camera, local = registration.camera, result.local_alignment
    record = SidecarRecord(
        format="rdstitch sidecar",
        version=VERSION,
        lambda_=alignment.distortion,
        lambda_std=alignment.distortion_std,
        lambda_px=camera.distortion_px,
        lambda_focal=camera.distortion_focal,
        lambda_known=alignment.lens_given,
        lens=cast(Lens, alignment.lens),
        lens_reason=alignment.lens_reason,
        camera=camera_record(camera),
        tilt_deg=in_degrees(alignment.tilt),
        focal_px=camera.focal,
        focal_source=camera.focal_source,
        model=cast(Model, alignment.model),
        model_reason=alignment.model_reason,
        rms_px=alignment.rms,
        reference=registration.sources[alignment.reference].name,
        output=output_record(result, turned=alignment.on_sphere),
        # The displacements are with their images.
        local_alignment=LocalAlignmentRecord(
            bool(local.fields), local.reason, local.cells, BeforeAfter(local.before, local.after)
        ),
        seams=seams_record(result.seams, registration.used_names),
        stage=_stage(registration),
        images=_images(result),
        pairs=_pairs(registration),
        verdict=VerdictRecord(
            registration.ok,
            [message.clause for message in registration.failures],
            [message.clause for message in registration.warnings],
            ReliefRecord(**dataclasses.asdict(alignment.relief)),
        ),
        options=dataclasses.asdict(result.options),
        seed=result.options.seed,
        versions=versions(),
    )
    content: dict[str, Any] = to_jsonable(record)
    return content


def _images(result: StitchResult) -> list[ImageRecord]:
    registration, alignment = result.registration, result.registration.alignment
    reasons = {Path(missing.images[0]): missing.text for missing in registration.left_out}
    records = []
    fields = iter(result.local_alignment.fields)
    for index, source in enumerate(registration.sources):
        used, homography = bool(alignment.used[index]), alignment.homographies[index]
        records.append(
            ImageRecord(
                source.name,
                recorded_path(source.path, result.output),
                source.camera.image_size,
                used,
                reasons.pop(source.path, ""),
                registration.keypoints[index],
                to_plane=to_lists(homography) if used else None,
                to_output=to_output(result.canvas, homography) if used else None,
                displacement=displacement_record(next(fields, None) if used else None),
                pose=_pose(registration, index) if used else None,
                **taken_fields(source),
                **lens_fields(alignment.cameras[index]),
            )
        )
    return records + [
        ImageRecord(path.name, recorded_path(path, result.output), None, False, reason)
        for path, reason in reasons.items()
    ]


def _pose(registration: Registration, index: int) -> PoseRecord | None:
    poses = registration.alignment.poses
    if poses is None:
        return None
    return PoseRecord(
        poses.position[index, 0],
        poses.position[index, 1],
        poses.height[index],
        np.degrees(poses.yaw[index]),
        in_degrees(poses.tilt[index]),
        None if poses.covariance is None else to_lists(poses.covariance[index]),
    )


def _stage(registration: Registration) -> StageRecord | None:
    """What the stage does, and which tiles have their places from it alone; None where the images are no tiles."""
    if registration.tiles is None:
        return None
    grid, model = registration.tiles.grid, registration.tiles.adjustment.stage
    # Whole pixels are another source of error.
    stds = np.hypot(registration.tiles.stds, 0.0 if registration.alignment.distortion else math.sqrt(1.0 / 12.0))
    lines = zip(registration.sources, grid.rows, grid.columns, registration.tiles.linked, stds, strict=True)
    return StageRecord(
        source=grid.source,
        pixel_um=grid.pixel_size,
        z=registration.tiles.z,
        time=registration.tiles.time,
        matrix=to_lists(model.matrix),
        rows_px=to_lists(model.rows),
        columns_px=to_lists(model.columns),
        row_std_px=model.row_std,
        column_std_px=model.column_std,
        tile_std_px=model.std,
        tiles=[
            TileRecord(source.name, int(row), int(column), "overlap" if linked else "stage", std)
            for source, row, column, linked, std in lines
        ],
    )


def _pairs(registration: Registration) -> list[PairRecord]:
    fits = {fit.images: fit for fit in registration.alignment.links}
    names = [source.name for source in registration.sources]

    def record(pair: PairRegistration) -> PairRecord:
        relation, fit = pair.relation, fits.get(pair.images)
        return PairRecord(
            images=(names[pair.image1], names[pair.image2]),
            matches=len(pair.matches),
            inliers=int(relation.inliers.sum()),
            rms_px=relation.rms,
            lambda_=relation.distortion,
            lambda_std=relation.distortion_std if relation.ok else None,
            model=cast(Model | None, relation.model or None),
            homography=to_lists(relation.homography) if relation.ok else None,
            solver=relation.solver or None,
            iterations=relation.iterations,
            ok=relation.ok,
            reason=relation.reason,
            used=fit is not None and fit.used,
            dropped=fit.reason if fit is not None else "",
            inliers_of_whole=fit.inliers if fit is not None else None,
            rms_of_whole_px=fit.rms if fit is not None else None,
        )

    return [record(pair) for pair in registration.pairs]
