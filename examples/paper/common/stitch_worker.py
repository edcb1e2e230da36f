"""One stitcher on one set of pictures, in a process of its own; arguments: its name, OUT, the pictures.

It imports nothing of rdstitch but for rdstitch itself, so that it also runs in a Python that has only the peer.
The exit status is the stitcher's word on whether it succeeded.
"""

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any


def rdstitch(output: str, pictures: Sequence[str]) -> int:
    """``rdstitch mosaic`` without any setting."""
    errors, pipeline = import_module("rdstitch.errors"), import_module("rdstitch.pipeline")
    try:
        pipeline.mosaic(pictures, output)
    except errors.RdstitchError as error:
        print(error, file=sys.stderr)
        return int(error.exit_status)
    return 0


def rdstitch_sphere(output: str, pictures: Sequence[str]) -> int:
    """``rdstitch mosaic --projection sphere``."""
    errors, package = import_module("rdstitch.errors"), import_module("rdstitch")
    options = package.StitchOptions(composite=package.CompositeOptions(projection="sphere"))
    try:
        package.mosaic(pictures, output, options)
    except errors.RdstitchError as error:
        print(error, file=sys.stderr)
        return int(error.exit_status)
    return 0


def opencv_panorama(output: str, pictures: Sequence[str]) -> int:
    """OpenCV's Stitcher for a camera that turns."""
    return _opencv(output, pictures, 0)


def opencv_scans(output: str, pictures: Sequence[str]) -> int:
    """OpenCV's Stitcher for a camera that moves over a plane, by affine transforms."""
    return _opencv(output, pictures, 1)


def _opencv(output: str, pictures: Sequence[str], mode: int) -> int:
    cv2 = import_module("cv2")
    status, mosaic = cv2.Stitcher.create(mode).stitch([cv2.imread(name) for name in pictures])
    if status == 0:
        cv2.imwrite(output, mosaic)
    return int(status)


def stitching_rotation(output: str, pictures: Sequence[str]) -> int:
    """``Stitcher`` of the package stitching, not cropped."""
    return _stitching(output, pictures, "Stitcher")


def stitching_affine(output: str, pictures: Sequence[str]) -> int:
    """``AffineStitcher`` of the package stitching, not cropped."""
    return _stitching(output, pictures, "AffineStitcher")


def _stitching(output: str, pictures: Sequence[str], kind: str) -> int:
    package = import_module("stitching")
    mosaic = getattr(package, kind)(crop=False).stitch(list(pictures))
    import_module("cv2").imwrite(output, mosaic)
    return 0


WORKERS: dict[str, Callable[[str, Sequence[str]], int]] = {
    worker.__name__: worker
    for worker in (rdstitch, rdstitch_sphere, opencv_panorama, opencv_scans, stitching_rotation, stitching_affine)
}


def main(arguments: Sequence[str]) -> int:
    """Run the worker that the arguments name."""
    name, output, *pictures = arguments
    worker: Any = WORKERS[name]
    return int(worker(output, pictures))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
