"""The same folder at other sizes: ``python -m examples.benchmarks.scales FOLDER... [--calibrate]``.

Every folder is registered as it is, at half its size and enlarged twice, as ``mosaic`` does, or ``calibrate``. Printed
are the images used, λ and its standard deviation, and how far λ is from that of the folder as it is, in standard
deviations of the less certain one. Images are handed on as arrays, so that their headers do not matter.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

import rdstitch
from examples.benchmarks.driver import images_of, run
from rdstitch.errors import RdstitchError
from rdstitch.features.prepared_image import PixelArray
from rdstitch.io.read import read_image

SCALES = (1.0, 0.5, 2.0)


@dataclass(frozen=True)
class Outcome:
    """What became of a folder.

    ``distortion``, ``deviation``: λ and its standard deviation; NaN without a result.
    """

    status: int  # exit status of the command line
    used: tuple[bool, ...]  # which images are in the result
    distortion: float
    deviation: float
    text: str  # why it was refused, or all messages


def resized(image: PixelArray, scale: float) -> PixelArray:
    """An image at another size."""
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    return image if scale == 1.0 else np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=how))


def outcome_of(images: Sequence[PixelArray], *, calibrate: bool) -> Outcome:
    """Register images as the command line does."""
    options = rdstitch.StitchOptions(workers=1, channel_order="rgb", dry_run=not calibrate)
    try:
        if calibrate:
            registration = rdstitch.calibrate(images, options)
        else:
            registration = rdstitch.mosaic(images, None, options).registration
    except RdstitchError as error:
        return Outcome(error.exit_status, (False,) * len(images), math.nan, math.nan, str(error))
    found = registration.alignment
    text = "; ".join(map(str, registration.messages))
    return Outcome(0, tuple(found.used.tolist()), found.distortion, found.distortion_std, text)


def main(folders: tuple[Path, ...], *, calibrate: bool = False, messages: bool = False) -> None:
    """Print a line for every folder and size."""
    for folder in folders:
        images, first = [read_image(file).pixels for file in images_of(folder)], None
        for scale in SCALES:
            start = time.process_time()
            found = outcome_of([resized(image, scale) for image in images], calibrate=calibrate)
            first = first or found
            away = abs(found.distortion - first.distortion) / max(found.deviation, first.deviation)
            print(
                f"{folder.name} x{scale:g}: status {found.status}, {sum(found.used)} of {len(found.used)} images "
                f"({sum(a != b for a, b in zip(found.used, first.used, strict=True))} others), "
                f"λ = {found.distortion:.4f} ± {found.deviation:.4f} ({away:.1f} σ away), "
                f"{time.process_time() - start:.0f} s",
                flush=True,
            )
            if found.status or messages:
                print(f"    {found.text}")


if __name__ == "__main__":
    run(main)
