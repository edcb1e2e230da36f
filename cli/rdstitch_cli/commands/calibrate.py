"""``rdstitch calibrate``: the lens, from pictures of a plane."""

from pathlib import Path
from typing import Any

import click

from rdstitch_cli import options
from rdstitch_cli.help_pages import GroupedCommand
from rdstitch_cli.stitching import Report, report_registration, stitch_options
from rdstitch_cli.terminal import Reporter


@click.command(
    cls=GroupedCommand,
    epilog="""\b
Examples:
  rdstitch calibrate wall/ -o camera.json
  rdstitch calibrate wall/ -o camera.yml --report lens.html
  rdstitch undistort other/*.jpg --camera camera.json -o straight/
""",
)
@options.inputs
@click.option(
    "-o",
    "--output",
    type=options.PICTURE,
    required=True,
    metavar="FILE",
    help="Camera file to write: .json, .yml and .fisheye.yml (OpenCV), .pto (Hugin), cameras.json (OpenDroneMap), "
    "cameras.txt (COLMAP), camera_info.yaml (ROS), camchain.yaml (Kalibr).",
)
@options.every
@options.topic
@options.registration
def calibrate(
    inputs: tuple[Path, ...],
    output: Path,
    every: int | None,
    report: Path | None,
    as_json: bool,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Find λ, and where they can be seen the tilt and the focal length, from pictures of a plane.

    λ goes to standard output; how far the lens is determined, and whether it takes more than λ, to standard error.

    INPUT is what 'rdstitch mosaic' takes. The camera file is what 'undistort', 'pano' and 'mosaic' take as --camera.
    """
    from rdstitch.alignment.lens_description import describe_lens
    from rdstitch.camera_files import export_note
    from rdstitch.pipeline import calibrate as recipe

    wanted = stitch_options(reporter, save_camera=output, **given)
    paths = options.resolve(inputs)
    report_page = Report(report, reporter, paths, given["overwrite"])
    with report_page.explaining():
        registration = recipe(paths, wanted, every=every, progress=report_page.progress, beside=report_page.stage)
    report_registration(registration, reporter, as_json=as_json)
    for line in (
        *describe_lens(registration.alignment, registration.camera),
        *export_note(registration.camera, output),
    ):
        reporter.note(line)
    reporter.made(f"{output}: {registration.summary}")
