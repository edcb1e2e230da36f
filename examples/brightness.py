"""What each choice of ``--exposure`` does to a flight: python -m examples.brightness IMAGE … -o FILE.

Stitches the images once for every choice, registered once, and writes the results side by side: samples as they are,
one gain per image, gains and smooth fields, and balanced, the default.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from rdstitch.compositing import CompositeOptions
from rdstitch.features.prepared_image import PixelArray
from rdstitch.io.write import write_image
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.recipes import mosaic

CHOICES = ("none", "gain", "blocks", "balanced")
GAP = 6  # pixels between two results


def main() -> None:
    """Read the command line, stitch, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--size", type=int, default=420, help="longest side of each result, pixels")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        options = StitchOptions(cache=Path(cache), composite=CompositeOptions(max_size=given.size, background=255))
        results = [_stitched(given.images, options, choice) for choice in CHOICES]
    gap = np.full((results[0].shape[0], GAP, results[0].shape[2]), 255, results[0].dtype)
    parts = [part for result in results for part in (result, gap)][:-1]
    write_image(given.output, np.concatenate(parts, axis=1), quality=82)


def _stitched(images: list[Path], options: StitchOptions, choice: str) -> PixelArray:
    composite = replace(options.composite, exposure=choice)  # type: ignore[arg-type]
    found = mosaic(images, None, replace(options, composite=composite)).composite
    assert found is not None
    covered = found.alpha[..., None] > 0
    return np.asarray(np.where(covered, found.pixels, np.iinfo(found.pixels.dtype).max))


if __name__ == "__main__":
    main()
