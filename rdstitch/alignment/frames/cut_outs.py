"""Images of unequal size whose pixels are equally large, as of scans and crops: one lens in pixels, not in diagonals.

Of a photograph that was made smaller, the lens in half diagonals stays; of one that was cut, the lens in pixels. Cut
images are aligned as the middle parts of frames of one size, which have one lens in both units.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment.result import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import LENS_PARAMETERS, Camera
from rdstitch.geometry.division_model import MAX_ABS_DISTORTION
from rdstitch.matching.links import Link

Size = tuple[int, int]


def common_size(cameras: Sequence[Camera], links: Sequence[Link]) -> Size | None:
    """Size of a frame that holds each of cut images; None of images that are of one size, or were made smaller.

    The links say which: what both images of one show is as large in both if they were cut.
    """
    changes = [
        (math.log(_extent(link.points2) / _extent(link.points1)), math.log(two.scale / one.scale))
        for link, one, two in ((link, cameras[link.image1], cameras[link.image2]) for link in links)
    ]
    cut, resized = (sum(abs(change - by_size * k) for change, by_size in changes) for k in (0.0, 1.0))
    # A lens that is given, or draws a circle, is one of whole images.
    if cut >= resized or any(any(camera.coefficients) or camera.image_circle for camera in cameras):
        return None
    widths, heights = zip(*(camera.image_size for camera in cameras), strict=True)
    return max(widths), max(heights)


def _extent(points: FloatArray) -> float:
    return max(float(np.linalg.norm(points - points.mean(axis=0))), 1e-9)


def framed_camera(camera: Camera, size: Size) -> Camera:
    """The camera of a larger frame, or of a smaller cut-out, with the same middle."""
    x, y = np.asarray(camera.center) + _margin(camera.image_size, size)
    scaled = _with_scaled_lens(camera, math.hypot(*size) / 2.0 / camera.scale)
    return replace(scaled, image_size=size, center=(float(x), float(y)))


def framed_link(link: Link, size: Size) -> Link:
    """The same correspondences in frames with the images in their middles."""
    relation = link.relation
    one, two = relation.camera, relation.camera2
    camera, camera2 = framed_camera(one, size), framed_camera(two, size)
    first, second = (np.array([a.scale / b.scale] * 2 + [1.0]) for a, b in ((one, camera), (two, camera2)))
    return replace(
        link,
        points1=link.points1 + _margin(one.image_size, size),
        points2=link.points2 + _margin(two.image_size, size),
        relation=replace(
            relation.reexpressed(second[:, None] * relation.homography / first, camera, camera2),
            distortion_std=relation.distortion_std / first[0] ** 2,
        ),
    )


def cut_alignment(alignment: Alignment, sizes: Sequence[Size]) -> Alignment:
    """The alignment of images of these sizes, by that of frames with them in their middles."""
    framed, size = alignment.cameras, alignment.cameras[0].image_size
    ratios = np.array([math.hypot(*image_size) / math.hypot(*size) for image_size in sizes])
    reference = float(ratios[alignment.reference])
    homographies = alignment.homographies * np.stack([ratios, ratios, np.ones(len(ratios))], axis=1)[:, None]
    if alignment.poses is None and not alignment.on_sphere:  # the plane is the undistorted reference image
        homographies = homographies / np.array([reference, reference, 1.0])[:, None]
    powers = _powers(reference)
    units = np.array([powers.get(name, 1.0) for name in alignment.parameters])
    cameras = tuple(map(framed_camera, framed, sizes))
    return replace(
        alignment, cameras=cameras, homographies=homographies, covariance=units[:, None] * alignment.covariance * units
    )


def _with_scaled_lens(camera: Camera, ratio: float) -> Camera:
    """The same lens where half the diagonal is so many times as long."""
    powers = _powers(ratio)
    units, covariance = np.array([powers[name] for name in LENS_PARAMETERS]), camera.lens_covariance
    if covariance is not None:
        covariance = tuple(map(tuple, (units[:, None] * np.array(covariance) * units).tolist()))
    return replace(
        camera,
        # What a camera cannot have is only the estimate of a single pair, where no match reaches.
        distortion=min(camera.distortion * powers["distortion"], MAX_ABS_DISTORTION),
        distortion2=camera.distortion2 * powers["distortion2"],
        distortion3=camera.distortion3 * powers["distortion3"],
        distortion_std=None if camera.distortion_std is None else camera.distortion_std * powers["distortion"],
        lens_covariance=covariance,
    )


def _powers(ratio: float) -> dict[str, float]:
    """What multiplies each parameter of a lens where half the diagonal is so many times as long."""
    return dict(zip(LENS_PARAMETERS, (ratio**2, ratio**4, ratio**6, 1.0 / ratio, 1.0 / ratio), strict=True))


def _margin(size: Size, frame: Size) -> FloatArray:
    """Margin of a frame around an image in its middle, pixels (2,)."""
    return (np.asarray(frame, dtype=np.float64) - size) / 2.0
