"""A seam over rough ground, before and after: python -m examples.rough_ground [PICTURE …] -o FILE [--at LEFT TOP].

Stitches pictures (by default the bundled pair) with ``--local-alignment off`` and ``auto``, both cut where pictures are
equally far from their borders and not blended, so that one sees how well they join. Writes one place of both, by
default that where they differ most, off on the left, px for px.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from examples.seams import BUNDLED, GAP, SIDE, largest_difference
from rdstitch.compositing import CompositeOptions
from rdstitch.io import write_image
from rdstitch.pipeline import StitchOptions, StitchResult, mosaic

CUT = CompositeOptions(seam="voronoi", blend="none")


def main() -> None:
    """Read the command line, stitch twice, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", nargs="*", type=Path, default=BUNDLED)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--at", nargs=2, type=int, metavar=("LEFT", "TOP"), help="place, px of the output")
    given = parser.parse_args()
    options = StitchOptions(composite=CUT)
    off, on = (_stitched(given.pictures, replace(options, local_alignment=choice)) for choice in ("off", "auto"))
    pictures = [np.dstack([done.composite.pixels, done.composite.alpha]) for done in (off, on) if done.composite]
    top, left = given.at[::-1] if given.at else largest_difference(pictures[0], pictures[1])
    crops = [picture[top : top + SIDE, left : left + SIDE, :-1] for picture in pictures]
    gap = np.full((SIDE, GAP, crops[0].shape[2]), 255, crops[0].dtype)
    write_image(given.output, np.concatenate([crops[0], gap, crops[1]], axis=1), quality=85)
    print(f"px {left}, {top}; {on.local_alignment.reason}")


def _stitched(pictures: list[Path], options: StitchOptions) -> StitchResult:
    return mosaic(pictures, None, options)


if __name__ == "__main__":
    main()
