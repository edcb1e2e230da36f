"""A seam over rough ground, before and after: python -m examples.rough_ground [PICTURE …] -o FILE [--at LEFT TOP].

Stitches pictures (by default the bundled pair) with ``--local-alignment off`` and ``auto``, both cut where pictures are
equally far from their borders and not blended, so that one sees how well they join. Writes one place of both, by
default that where they differ most, off on the left, px for px.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from examples.seams import arguments, write_beside
from rdstitch.compositing import CompositeOptions
from rdstitch.pipeline import StitchOptions, StitchResult, mosaic

CUT = CompositeOptions(seam="voronoi", blend="none")


def main() -> None:
    """Read the command line, stitch twice, write."""
    given = arguments(__doc__)
    options = StitchOptions(composite=CUT)
    off, on = (_stitched(given.pictures, replace(options, local_alignment=choice)) for choice in ("off", "auto"))
    first, second = (np.dstack([done.composite.pixels, done.composite.alpha]) for done in (off, on) if done.composite)
    left, top = write_beside(given, first, second)
    print(f"pixel {left}, {top}; {on.local_alignment.reason}")


def _stitched(pictures: list[Path], options: StitchOptions) -> StitchResult:
    return mosaic(pictures, None, options)


if __name__ == "__main__":
    main()
