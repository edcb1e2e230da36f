"""One stitcher on one set of images, in a process of its own; arguments: its name, OUT, the images.

It imports nothing of rdstitch but for rdstitch itself, so that it also runs in a Python that has only the peer.
The exit status is the stitcher's word on whether it succeeded.
"""

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any


def rdstitch(output: str, images: Sequence[str]) -> int:
    """``rdstitch mosaic`` without any setting."""
    errors, package = import_module("rdstitch.errors"), import_module("rdstitch")
    try:
        package.mosaic(images, output)
    except errors.RdstitchError as error:
        print(error, file=sys.stderr)
        return int(error.exit_status)
    return 0


def rdstitch_sphere(output: str, images: Sequence[str]) -> int:
    """``rdstitch mosaic --projection sphere``."""
    errors, package = import_module("rdstitch.errors"), import_module("rdstitch")
    options = package.StitchOptions(composite=package.CompositeOptions(projection="sphere"))
    try:
        package.mosaic(images, output, options)
    except errors.RdstitchError as error:
        print(error, file=sys.stderr)
        return int(error.exit_status)
    return 0


def opencv_panorama(output: str, images: Sequence[str]) -> int:
    """OpenCV's Stitcher for a camera that turns."""
    return _opencv(output, images, 0)


def opencv_scans(output: str, images: Sequence[str]) -> int:
    """OpenCV's Stitcher for a camera that moves over a plane, by affine transforms."""
    return _opencv(output, images, 1)


def _opencv(output: str, images: Sequence[str], mode: int) -> int:
    cv2 = import_module("cv2")
    status, mosaic = cv2.Stitcher.create(mode).stitch([cv2.imread(name) for name in images])
    if status == 0:
        cv2.imwrite(output, mosaic)
    return int(status)


def stitching_rotation(output: str, images: Sequence[str]) -> int:
    """``Stitcher`` of the package stitching, not cropped."""
    return _stitching(output, images, "Stitcher")


def stitching_affine(output: str, images: Sequence[str]) -> int:
    """``AffineStitcher`` of the package stitching, not cropped."""
    return _stitching(output, images, "AffineStitcher")


def _stitching(output: str, images: Sequence[str], kind: str) -> int:
    package = import_module("stitching")
    mosaic = getattr(package, kind)(crop=False).stitch(list(images))
    import_module("cv2").imwrite(output, mosaic)
    return 0


WORKERS: dict[str, Callable[[str, Sequence[str]], int]] = {
    worker.__name__: worker
    for worker in (rdstitch, rdstitch_sphere, opencv_panorama, opencv_scans, stitching_rotation, stitching_affine)
}


def main(arguments: Sequence[str]) -> int:
    """Run the worker that the arguments name."""
    name, output, *images = arguments
    worker: Any = WORKERS[name]
    return int(worker(output, images))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
