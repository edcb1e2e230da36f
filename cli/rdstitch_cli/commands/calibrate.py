"""``rdstitch calibrate``: the lens, from images of a plane."""

from pathlib import Path
from typing import Annotated, Any

from rdstitch.options.feature_options import FeatureOptions
from rdstitch.options.files_beside import ReportFile
from rdstitch.options.option import FileUse, Option
from rdstitch.options.shared_options import Every
from rdstitch.options.stitch_options import StitchOptions
from rdstitch_cli.flags import Inputs, command, flags_of
from rdstitch_cli.stitching import files_beside, report_registration, resolve, stitch_options
from rdstitch_cli.terminal import Reporter


@command(
    """
  rdstitch calibrate wall/ -o camera.json
  rdstitch calibrate wall/ -o camera.yml --report lens.html
  rdstitch undistort other/*.jpg --camera camera.json -o straight/
""",
    flags_of(StitchOptions, without="odometry reference gcp check_points local_alignment dry_run save_camera"),
    flags_of(FeatureOptions),
    flags_of(ReportFile),
)
def calibrate(
    inputs: Inputs,
    output: Annotated[
        Path,
        Option(
            "Camera file to write: .json, or in the format of others, see --camera-format.",
            "FILE",
            "-o --output",
            file=FileUse.WRITTEN,
        ),
    ],
    every: Every = None,
    as_json: Annotated[bool, Option("Print the camera as JSON.", flag="--json")] = False,
    *,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Find λ, focal length and tilt from images of a plane, and how well each is known.

    λ goes to standard output; focal length, tilt and what else the lens takes, each with its standard deviation, to
    standard error. All are in the camera file.

    INPUT is what 'rdstitch mosaic' takes. 'undistort', 'pano', 'mosaic' and 'trajectory' take the camera file as
    --camera: the lens as given, the focal length within its standard deviation; for the tilt, which belongs to how the
    camera was mounted, use --tilt.
    """
    from rdstitch.alignment.lens.lens_description import describe_camera
    from rdstitch.camera_files import export_note
    from rdstitch.geometry.camera_record import camera_json
    from rdstitch.pipeline.recipes import calibrate as recipe

    paths = resolve(inputs)
    beside = files_beside(given)
    wanted = stitch_options(given, save_camera=output)
    registration = recipe(paths, wanted, every=every, progress=reporter, beside=beside)
    report_registration(registration, reporter, (lambda: camera_json(registration.camera)) if as_json else None)
    for line in (
        *describe_camera(registration.alignment, registration.camera),
        *export_note(registration.camera, output, wanted.camera_format),
    ):
        reporter.note(line)
    reporter.made(f"{output}: {registration.summary}")
