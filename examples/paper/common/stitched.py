"""Sequences through rdstitch's own recipes, and how far the result is from the truth."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from examples.paper.common.report import Pixels
from rdstitch.errors import RegistrationError
from rdstitch.io.read import read_image
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.recipes import calibrate, mosaic
from rdstitch.results.registration import Registration
from rdstitch.synthetic import RenderedSequence


def stitch_files(files: Sequence[Path], options: StitchOptions) -> tuple[Registration, Pixels]:
    """The registration and the mosaic of some images."""
    with TemporaryDirectory(prefix="rdstitch-paper-") as folder:
        output = Path(folder) / "mosaic.png"
        result = mosaic(files, output, options)
        return result.registration, np.asarray(read_image(output).pixels)


def stitch_rendered(sequence: RenderedSequence, options: StitchOptions) -> tuple[Registration, Pixels]:
    """The same of a rendered sequence."""
    with TemporaryDirectory(prefix="rdstitch-paper-") as folder:
        return stitch_files(sequence.write(folder), options)


def register_files(files: Sequence[Path], options: StitchOptions) -> Registration | str:
    """The registration alone; the reason where there is none."""
    try:
        return calibrate(files, options)
    except RegistrationError as error:
        return str(error)
