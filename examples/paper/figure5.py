"""Fig. 5: a pair through a fisheye lens, which is no division model, rectified and stitched; and a real pair."""

from examples.judging import registration_error
from examples.paper.common.matched import rendered_pair
from examples.paper.common.report import Effort, Pixels, Report, Settings, Table
from examples.paper.common.stitched import stitch_files, stitch_rendered
from rdstitch.camera_files.lens_models import fit_lens
from rdstitch.errors import RegistrationError
from rdstitch.geometry.camera import Camera
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.synthetic import FisheyeLens
from rdstitch.synthetic.lenses import Lens

REAL_PAIRS = {"garfield_red": -0.234, "garfield_gre": -0.231}
"""Real sequences with λ of the maker's calibration."""

_TILT = (0.06, -0.04)
_FOCAL_PER_WIDTH = (0.5, 0.55, 0.7)  # equidistant fisheyes from extreme to moderate


def run(settings: Settings) -> Report:
    """λ beside that of the best division model, and the distance from the true plane."""
    size = (320, 240) if settings.effort is Effort.TINY else (640, 480)
    focals = _FOCAL_PER_WIDTH[-1:] if settings.effort is Effort.TINY else _FOCAL_PER_WIDTH
    rows, images = [], {}
    for k, share in enumerate(focals):
        row, image = _rendered(FisheyeLens(size, share * size[0]), seed=50 + k)
        rows.append(row)
        images[f"figure5_fisheye{k}.jpg"] = image
    header = (
        "focal length, px", "λ", "λ of the best division model", "its misfit, px", "model",
        "median error, px", "95 %, px", "warned",
    )  # fmt: skip
    title = f"Fig. 5: rendered pairs through an equidistant fisheye, {size[0]}x{size[1]} px, errors on the true plane"
    tables, notes = [Table(title, header, tuple(rows))], []
    real: list[tuple[object, ...]] = []
    for name, truth in REAL_PAIRS.items():
        files = settings.real_sequence(name)[:2]
        if not files:
            notes.append(f"the real images {name} are not here and were left out")
            continue
        try:
            registration, image = stitch_files(files, StitchOptions())
        except RegistrationError as error:
            real.append((name, None, truth, None, f"failed: {error}"))
            continue
        alignment = registration.alignment
        real.append((name, alignment.distortion, truth, alignment.rms, alignment.model))
        images[f"figure5_{name}.jpg"] = image
    if real:
        columns = ("pair", "λ", "λ of the maker's calibration", "rms, px", "model")
        tables.append(Table("Fig. 5: the first two images of real sequences", columns, tuple(real)))
    return Report(tuple(tables), images=images, notes=tuple(notes))


def _rendered(lens: Lens, seed: int) -> tuple[tuple[object, ...], Pixels]:
    """One row, and the stitched pair."""
    sequence = rendered_pair(lens, seed=seed, tilt=_TILT, overlap=0.5)
    registration, image = stitch_rendered(sequence, StitchOptions())
    error = registration_error(registration.alignment, sequence)
    exact, _ = fit_lens(lens.distort, Camera(lens.image_size, center=lens.center, focal=lens.focal))
    nearest, misfit, _ = exact.one_parameter_fit()
    return (
        lens.focal,
        registration.alignment.distortion,
        nearest,
        misfit,
        registration.alignment.model,
        error.median,
        error.percentile95,
        "yes" if any(message.code == "few-images" for message in registration.alignment.messages) else "no",
    ), image
