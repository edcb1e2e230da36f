"""``rdstitch calibrate``: the lens, from images of a plane."""

from pathlib import Path
from typing import Any

from rdstitch_cli import options
from rdstitch_cli.help_pages import command
from rdstitch_cli.option_texts import option
from rdstitch_cli.stitching import files_beside, report_registration, stitch_options
from rdstitch_cli.terminal import Reporter


@command(
    "The lens, from images of a plane.",
    """
  rdstitch calibrate wall/ -o camera.json
  rdstitch calibrate wall/ -o camera.yml --report lens.html
  rdstitch undistort other/*.jpg --camera camera.json -o straight/
""",
)
@options.inputs
@option("-o --output", options.IMAGE, of="calibrate", required=True)
@options.camera_format
@options.every
@options.topic
@options.registration
@options.as_json("the camera")
@options.verbosity
def calibrate(
    inputs: tuple[Path, ...],
    output: Path,
    every: int | None,
    as_json: bool,
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
    from rdstitch.alignment.lens_description import describe_camera
    from rdstitch.camera_files import export_note
    from rdstitch.pipeline.recipes import calibrate as recipe
    from rdstitch.sidecar.write import plain

    paths = options.resolve(inputs)
    beside = files_beside(reporter, given)
    wanted = stitch_options(reporter, save_camera=output, **given)
    registration = recipe(paths, wanted, every=every, progress=beside.timer, beside=beside)
    report_registration(registration, reporter, (lambda: plain(registration.camera.as_dict())) if as_json else None)
    for line in (
        *describe_camera(registration.alignment, registration.camera),
        *export_note(registration.camera, output, wanted.camera_format),
    ):
        reporter.note(line)
    reporter.made(f"{output}: {registration.summary}")
