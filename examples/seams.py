"""A seam, before and after: python -m examples.seams [IMAGE …] -o FILE [--at LEFT TOP] [--of local-alignment].

Stitches images (by default the bundled pair) twice and writes one place of both side by side, pixel for pixel, by
default that where they differ most. Left: plain, without exposure, seams and blending; right: the defaults. With ``--of
local-alignment``: off and auto, both cut where images are equally far from their borders and not blended, so that one
sees how well they join over rough ground.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing import CompositeOptions
from rdstitch.io import write_image
from rdstitch.options import StitchOptions
from rdstitch.pipeline.recipes import mosaic

BUNDLED = sorted((Path(__file__).parent / "data" / "garfield_red").glob("*.jpg"))
CUT = StitchOptions(composite=CompositeOptions(seam="voronoi", blend="none"))
CHOICES = {
    "seams": (StitchOptions(composite=CompositeOptions(exposure="none", seam="none", blend="none")), StitchOptions()),
    "local-alignment": (replace(CUT, local_alignment="off"), CUT),
}
SIDE, GAP = 320, 8  # pixels


def stitched(images: list[Path], options: StitchOptions) -> NDArray[Any]:
    """The composite with its alpha as last channel."""
    result = mosaic(images, None, options)
    assert result.composite is not None
    print(f"{result!r}; local alignment: {result.local_alignment.reason}")
    return np.dstack([result.composite.pixels, result.composite.alpha])


def largest_difference(first: NDArray[Any], second: NDArray[Any]) -> tuple[int, int]:
    """Top and left of the square, covered by both, in which they differ most."""
    covered = ((first[..., -1] == 255) & (second[..., -1] == 255)).astype(np.float32)
    difference = np.abs(first[..., :-1].astype(np.float32) - second[..., :-1]).mean(axis=2) * covered
    # Steps along a seam count, not all of an image that is brighter by as much.
    edges = np.abs(cv2.Laplacian(cv2.GaussianBlur(difference, (0, 0), 4.0), cv2.CV_32F))
    whole = cv2.boxFilter(covered, -1, (SIDE, SIDE), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT) > 0.999
    score = cv2.boxFilter(edges, -1, (SIDE, SIDE), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT) * whole
    top, left = np.unravel_index(int(np.argmax(score)), score.shape)
    return int(top), int(left)


def main() -> None:
    """Read the command line, stitch twice, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", nargs="*", type=Path, default=BUNDLED)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--at", nargs=2, type=int, metavar=("LEFT", "TOP"), help="place, pixels of the output")
    parser.add_argument("--of", choices=CHOICES, default="seams", help="what is compared")
    given = parser.parse_args()
    first, second = (stitched(given.images, options) for options in CHOICES[given.of])
    top, left = given.at[::-1] if given.at else largest_difference(first, second)
    crops = [image[top : top + SIDE, left : left + SIDE, :-1] for image in (first, second)]
    gap = np.full((SIDE, GAP, crops[0].shape[2]), np.iinfo(first.dtype).max, first.dtype)
    write_image(given.output, np.concatenate([crops[0], gap, crops[1]], axis=1), quality=85)
    print(f"pixel {left}, {top} of {first.shape[1]} x {first.shape[0]}")


if __name__ == "__main__":
    main()
