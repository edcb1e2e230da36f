"""All files of a run: named and checked before its work, written with its result."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from rdstitch.export.layers import layer_files, make_folder, write_layers
from rdstitch.export.map_server import check_map_server, map_files, write_map
from rdstitch.export.poses_of_result import poses_file
from rdstitch.options.files_beside import FilesBeside
from rdstitch.pipeline.compose import image_files
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import Message
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.outputs import Outputs, check_outputs, check_suffix, text_bytes


def files_beside(beside: FilesBeside, output: Path | None, names: Iterable[str]) -> list[Path]:
    """All files beside the output of images of these names; makes the folders of the layers and of the map."""
    files = [file for file in (beside.report, beside.hugin_project, beside.poses) if file is not None]
    if beside.map_server is not None and output is not None:
        check_map_server(output, beside.height)
        make_folder(beside.map_server)
        files += map_files(beside.map_server)
    if beside.layers is not None:
        make_folder(beside.layers)
        files += layer_files(list(names), beside.layers)
    return files


def stage_beside(run: Run, outputs: Outputs, result: StitchResult | Registration) -> list[Message]:
    """Stage the files beside a result; a warning for each that fails."""
    beside = run.beside
    failed: list[Message] = []

    def attempt(place: Path | None, write: Callable[[Path], object]) -> None:
        if place is not None:
            failed.extend(outputs.attempt(place, partial(write, place)))

    attempt(beside.report, lambda file: _report(run, file, outputs, result))
    if isinstance(result, StitchResult) and result.plan is None:
        how = {"whole": beside.whole_layers, "overwrite": result.options.overwrite}
        attempt(beside.hugin_project, lambda file: _hugin_project(file, outputs, result))
        table = partial(poses_file, result, frame=beside.frame, height=beside.height or 1.0)
        attempt(beside.poses, lambda file: outputs.write(file, text_bytes(table(file))))
        attempt(beside.map_server, lambda folder: write_map(result, folder, beside.height or 1.0, outputs))
        attempt(beside.layers, lambda folder: write_layers(result, folder, **how, outputs=outputs))
    return failed


def report_refused(run: Run, refused: Registration) -> None:
    """Write the report of a result that is refused, so that one can see why."""
    if run.beside.report is not None:
        with Outputs(overwrite=True) as outputs:
            _report(run, run.beside.report, outputs, refused)


def _report(run: Run, file: Path, outputs: Outputs, result: StitchResult | Registration) -> None:
    # Imported late: most runs have none.
    from rdstitch.report import write_report

    write_report(file, result, run.progress.stages, run.beside.command, outputs=outputs)


def _hugin_project(file: Path, outputs: Outputs, result: StitchResult) -> None:
    # Imported late: most runs have none.
    from rdstitch.export.hugin_project import project_of_hugin

    outputs.write(file, text_bytes(project_of_hugin(result.registration, result.canvas)))


def check_run(
    run: Run,
    inputs: Iterable[str | Path],
    names: Iterable[str],
    further: Iterable[Path] = (),
    others: Iterable[Path] = (),
) -> None:
    """Find out before long work whether all that images of these names become can be written, over nothing read.

    ``further`` are images that may follow, ``others`` what else is written.
    """
    options = run.options
    images = [*([] if run.output is None else [run.output]), *further]
    files = [file for image in images for file in image_files(check_suffix(image))]
    if options.save_camera is not None:
        from rdstitch.camera_files import format_of

        format_of(options.save_camera, options.camera_format)
        files.append(options.save_camera)
    files += [*others, *files_beside(run.beside, None if run.output is None else Path(run.output), names)]
    check_outputs(files, options.overwrite, [*inputs, *options.files])
