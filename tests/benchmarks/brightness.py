"""Brightness of a composite measured: python -m tests.benchmarks.brightness SIDECAR FOLDER [--exposure CHOICE ...].

Images are put together by a sidecar, so that only the compositing is looked at. Printed for every choice of
``--exposure``, and for the images as they are:

gain
    Smallest and largest factor between an image's mean and what it has in the composite.
saturated
    Share of px with a channel at full scale, per cent: in all images, and in the composite.
median
    Grey level, 0-255, over all images, as they are and corrected.
seam
    Difference of the two images on either side of the seams, both low-passed over 2 % of an image's width, so that
    light counts and detail does not: mean and 95 %, grey levels.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from rdstitch.compositing import CompositeOptions, plan_canvas
from rdstitch.compositing.boxes import Float32Array
from rdstitch.compositing.photometric import full_scale
from rdstitch.compositing.placed_image import place_images
from rdstitch.compositing.preparation import prepare_composite
from rdstitch.compositing.seam_finder import NO_OWNER, SeamMap
from rdstitch.compositing.source_images import ImageReader
from rdstitch.compositing.survey import Survey, survey_images
from rdstitch.compositing.warp import locate
from rdstitch.inputs.source import read_sources
from rdstitch.sidecar.read import read_sidecar

CHOICES = ("none", "gain", "blocks", "balanced")


def seam_steps(seams: SeamMap, survey: Survey, corrected: list[Float32Array]) -> Float32Array:
    """Differences in grey levels of low-passed neighbours, at every reduced px beside a seam."""
    labels = seams.labels
    steps = []
    for axis in (0, 1):
        a, b = (labels[:-1], labels[1:]) if axis == 0 else (labels[:, :-1], labels[:, 1:])
        y, x = np.nonzero((a != b) & (a != NO_OWNER) & (b != NO_OWNER))
        for first, second in {*zip(a[y, x].tolist(), b[y, x].tolist(), strict=True)}:
            here = (a[y, x] == first) & (b[y, x] == second)
            values, seen = [], np.ones(int(here.sum()), dtype=np.bool_)
            for index in (first, second):
                tile = survey.tiles[index]
                assert tile is not None
                left, top, right, bottom = tile.box
                row, column = y[here] - top, x[here] - left
                inside = (row >= 0) & (column >= 0) & (row < bottom - top) & (column < right - left)
                row, column = np.where(inside, row, 0), np.where(inside, column, 0)
                seen &= inside & tile.inside[row, column]
                values.append(corrected[index][row, column])
            steps.append(np.abs(values[0] - values[1])[seen])
    return np.concatenate(steps).astype(np.float32)


def low_passed(pixels: Float32Array, inside: Float32Array) -> Float32Array:
    """Grey levels, 0-255, averaged over 2 % of the width."""
    sigma = 0.02 * pixels.shape[1]
    total = cv2.GaussianBlur(pixels.mean(axis=2) * inside, (0, 0), sigma)
    return np.asarray(total / np.maximum(cv2.GaussianBlur(inside, (0, 0), sigma), 1e-6), dtype=np.float32)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sidecar", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--exposure", nargs="+", choices=CHOICES, default=CHOICES)
    arguments = parser.parse_args()
    saved = read_sidecar(arguments.sidecar)
    used = [image for image in saved.images if image.to_plane is not None]
    sources, _ = read_sources(
        [arguments.folder / image.name for image in used], camera=None, focal=None, distortion=None, skip_bad=False
    )
    cameras = [image.camera for image in used if image.camera is not None]
    matrices = np.array([image.to_plane for image in used])
    canvas, read = plan_canvas(cameras, matrices), [source.read for source in sources]
    images = place_images(read, cameras, matrices, preview=read)
    survey = survey_images(ImageReader(images), images, canvas, 2)
    tiles = [tile for tile in survey.tiles if tile is not None]
    full = full_scale(tiles[0].pixels.dtype)
    inputs = np.concatenate([tile.pixels[tile.inside].astype(np.float32) for tile in tiles])
    print(f"{'':10} {'gain':>13} {'saturated %':>13} {'median':>13} {'seam mean':>10} {'95 %':>6}")
    for choice in arguments.exposure:
        options = CompositeOptions(exposure=choice)
        with prepare_composite(images, canvas, options) as ready:
            corrected = [
                ready.renderer.exposure.correct(k, locate(survey.warps[k], tile.box), tile.pixels).astype(np.float32)
                for k, tile in enumerate(survey.tiles)
                if tile is not None
            ]
            white = covered = 0
            for samples, alpha in ready.strips():
                white += int((samples[alpha > 0].max(axis=-1) >= full).sum())
                covered += int((alpha > 0).sum())
            seams = ready.renderer.seams
        assert seams is not None
        gains = [
            values[tile.inside].mean() / tile.pixels[tile.inside].mean()
            for values, tile in zip(corrected, tiles, strict=True)
        ]
        whites = float((inputs.max(axis=1) >= full).mean())
        after = np.concatenate([values[tile.inside] for values, tile in zip(corrected, tiles, strict=True)])
        smooth = [
            low_passed(values * np.float32(255.0 / full), tile.inside.astype(np.float32))
            for values, tile in zip(corrected, tiles, strict=True)
        ]
        steps = seam_steps(seams, survey, smooth)
        print(
            f"{choice:10} {min(gains):6.2f}-{max(gains):<6.2f} "
            f"{100 * whites:6.2f} {100 * white / covered:6.2f} "
            f"{np.median(inputs.mean(axis=1)) * 255 / full:6.1f} {np.median(after.mean(axis=1)) * 255 / full:6.1f} "
            f"{steps.mean():10.2f} {np.percentile(steps, 95):6.2f}"
        )


if __name__ == "__main__":
    main()
