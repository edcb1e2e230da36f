"""One stitcher on one set of images, in a process of its own; arguments: its name, OUT, the images.

It imports nothing of rdstitch but for rdstitch itself, so that it also runs in a Python that has only the peer.
The exit status is the stitcher's word on whether it succeeded.
"""

import sys
from collections.abc import Callable, Sequence
from importlib import import_module


def _rdstitch(output: str, images: Sequence[str], projection: str) -> int:
    errors, package = import_module("rdstitch.errors"), import_module("rdstitch")
    options = package.StitchOptions(composite=package.CompositeOptions(projection=projection))
    try:
        package.mosaic(images, output, options)
    except errors.RdstitchError as error:
        print(error, file=sys.stderr)
        return int(error.exit_status)
    return 0


def _opencv(output: str, images: Sequence[str], mode: int) -> int:
    cv2 = import_module("cv2")
    status, mosaic = cv2.Stitcher.create(mode).stitch([cv2.imread(name) for name in images])
    if status == 0:
        cv2.imwrite(output, mosaic)
    return int(status)


def _stitching(output: str, images: Sequence[str], kind: str) -> int:
    package = import_module("stitching")
    mosaic = getattr(package, kind)(crop=False).stitch(list(images))
    import_module("cv2").imwrite(output, mosaic)
    return 0


WORKERS: dict[str, tuple[Callable[..., int], object]] = {
    "rdstitch": (_rdstitch, "auto"),
    "rdstitch_sphere": (_rdstitch, "sphere"),
    "opencv_panorama": (_opencv, 0),
    "opencv_scans": (_opencv, 1),
    "stitching_rotation": (_stitching, "Stitcher"),
    "stitching_affine": (_stitching, "AffineStitcher"),
}
"""What runs a stitcher, and which one: OpenCV's for a camera that turns and for one that moves over a plane."""


def main(arguments: Sequence[str]) -> int:
    """Run the worker that the arguments name."""
    name, output, *images = arguments
    worker, which = WORKERS[name]
    return worker(output, images, which)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
