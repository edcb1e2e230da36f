"""Before and after: python -m examples.seams [PICTURE …] -o FILE [--at LEFT TOP].

Stitches pictures (by default the bundled pair), once plain, without exposure, seams and blending, and once with the
defaults, and writes one place of both, by default that where they differ most, plain on the left, pixel for pixel.
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
from rdstitch.pipeline import StitchOptions, mosaic

BUNDLED = sorted((Path(__file__).parent / "data" / "garfield_red").glob("*.jpg"))
PLAIN = CompositeOptions(exposure="none", seam="none", blend="none")
SIDE, GAP = 320, 8  # pixels


def stitched(pictures: list[Path], composite: CompositeOptions) -> NDArray[Any]:
    """The composite with its alpha as last channel."""
    done = mosaic(pictures, None, replace(StitchOptions(), composite=composite)).composite
    assert done is not None
    return np.dstack([done.pixels, done.alpha])


def largest_difference(first: NDArray[Any], second: NDArray[Any]) -> tuple[int, int]:
    """Top and left of the square, covered by both, in which they differ most."""
    covered = ((first[..., -1] == 255) & (second[..., -1] == 255)).astype(np.float32)
    difference = np.abs(first[..., :-1].astype(np.float32) - second[..., :-1]).mean(axis=2) * covered
    # Steps along a seam count, not all of a picture that is brighter by as much.
    edges = np.abs(cv2.Laplacian(cv2.GaussianBlur(difference, (0, 0), 4.0), cv2.CV_32F))
    whole = cv2.boxFilter(covered, -1, (SIDE, SIDE), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT) > 0.999
    score = cv2.boxFilter(edges, -1, (SIDE, SIDE), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT) * whole
    top, left = np.unravel_index(int(np.argmax(score)), score.shape)
    return int(top), int(left)


def arguments(description: str | None) -> argparse.Namespace:
    """Read pictures, output and place from the command line."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", nargs="*", type=Path, default=BUNDLED)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--at", nargs=2, type=int, metavar=("LEFT", "TOP"), help="place, pixels of the output")
    return parser.parse_args()


def write_beside(given: argparse.Namespace, first: NDArray[Any], second: NDArray[Any]) -> tuple[int, int]:
    """Write the same place of two mosaics side by side: the one given, or where they differ most.

    Returns
    -------
    (int, int)
        Left and top of the place, pixels.
    """
    top, left = given.at[::-1] if given.at else largest_difference(first, second)
    crops = [picture[top : top + SIDE, left : left + SIDE, :-1] for picture in (first, second)]
    gap = np.full((SIDE, GAP, crops[0].shape[2]), np.iinfo(first.dtype).max, first.dtype)
    write_image(given.output, np.concatenate([crops[0], gap, crops[1]], axis=1), quality=85)
    return left, top


def main() -> None:
    """Read the command line, stitch twice, write."""
    given = arguments(__doc__)
    plain, default = (stitched(given.pictures, options) for options in (PLAIN, CompositeOptions()))
    left, top = write_beside(given, plain, default)
    print(f"pixel {left}, {top} of {plain.shape[1]} x {plain.shape[0]}")


if __name__ == "__main__":
    main()
