"""Orientation (Bay et al., §4.1) and descriptor (§4.2) of keypoints, and SURF in the steps that all detectors take.

The orientation is the strongest sum of gradients within 60°. Two departures from the paper, which for turned images
bring its error from 6° to 0.6° (median) at no cost: the gradients are derivatives of Gaussians instead of Haar
wavelets, which are not isotropic; and the window has a smooth edge, so that a gradient near it does not decide by being
just in or out. The descriptor holds sums of Haar responses in 4 x 4 cells of a patch that is turned by it.
"""

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.keypoints import Detection, Features
from rdstitch.features.surf.hessian import find_blobs
from rdstitch.features.surf.patches import Grey, apply_kernels, integer_kernels, pyramid, sample_patches
from rdstitch.features.surf.refinement import refine

_THRESHOLD = 100.0  # determinant of the Hessian from which on a blob counts, grey levels²
_OCTAVES = 4  # of scale
_LAYERS = 3  # scales per octave
_RADIUS = 6  # of the disc of gradients, units of s
_GRADIENT_SIGMA = 1.5  # of the derivatives, units of s; about as wide as the paper's wavelets of 4s
_GRADIENT_WEIGHT_SIGMA = 2.5  # of the gradients' weight, units of s
_PATCH = 2 * (_RADIUS + 3)
_BINS = 72  # directions in which the window is tried
_WINDOW_WIDTH = np.pi / 3  # width of the window at half its height, radians
_ORIENTED_AT_ONCE = 4096  # worked on at a time
_CELLS = 4  # along each side
_SAMPLES = 5  # along each side of a cell
_SIDE = _CELLS * _SAMPLES  # of the region, in units of s
_RESPONSE_SIGMA = 3.3  # of the Gaussian weight, in units of s
_SUPERSAMPLING = 2  # samples along each side of a square of s
_DESCRIBED_AT_ONCE = 512  # worked on at a time


def orientations(levels: list[Grey], points: FloatArray, scale: FloatArray) -> FloatArray:
    """Direction of the gradient at points (N, 2) of a pyramid, radians in [0, 2π), from u towards v.

    ``scale`` (N,) is the s of the paper, pixels.
    """
    angles = np.empty(len(points))
    for start in range(0, len(points), _ORIENTED_AT_ONCE):
        part = slice(start, start + _ORIENTED_AT_ONCE)
        patches = sample_patches(levels, points[part], scale[part], np.zeros(len(points[part])), _PATCH)
        angles[part] = _dominant(
            apply_kernels(patches, _ALONG_U) * _GRADIENT_WEIGHTS, apply_kernels(patches, _ALONG_V) * _GRADIENT_WEIGHTS
        )
    return angles


def _dominant(du: NDArray[np.float32], dv: NDArray[np.float32]) -> FloatArray:
    """Direction of the largest sum of gradients (N, places) that a window holds."""
    count = len(du)
    bins = np.floor(np.arctan2(dv, du) * (_BINS / (2 * np.pi))).astype(np.intp) % _BINS
    address = (bins + _BINS * np.arange(count)[:, None]).ravel()
    sums = np.stack([np.bincount(address, d.ravel(), count * _BINS).reshape(count, _BINS) for d in (du, dv)])
    window = np.fft.irfft(np.fft.rfft(sums) * _WINDOW_SPECTRUM, _BINS)
    best = (window**2).sum(axis=0).argmax(axis=1)
    u, v = window[:, np.arange(count), best]
    return np.asarray(np.arctan2(v, u) % (2 * np.pi))


def _gradients() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Derivatives along u and v at the places of the disc, each (pixels, places), and the places' weights."""
    step = np.arange(-_RADIUS, _RADIUS + 1)
    row, column = (axis.ravel() for axis in np.meshgrid(step, step, indexing="ij"))
    inside = row**2 + column**2 <= _RADIUS**2
    row, column = row[inside], column[inside]
    pixel = np.arange(_PATCH) - (_PATCH - 1) / 2
    v, u = np.broadcast_arrays(pixel[:, None, None] - row, pixel[None, :, None] - column)
    gauss = np.exp(-(u**2 + v**2) / (2 * _GRADIENT_SIGMA**2))
    along_u, along_v = (integer_kernels((axis * gauss).reshape(_PATCH**2, -1))[0] for axis in (u, v))
    return along_u, along_v, np.exp(-(row**2 + column**2) / (2 * _GRADIENT_WEIGHT_SIGMA**2)).astype(np.float32)


def _window_spectrum() -> NDArray[np.complex128]:
    """Transform of the window over the bins: cos², half as high at half its width."""
    bins = (np.arange(_BINS) + _BINS // 2) % _BINS - _BINS // 2
    angle = bins * (2 * np.pi / _BINS)
    return np.fft.rfft(np.where(np.abs(angle) < _WINDOW_WIDTH, np.cos(angle * (np.pi / 2 / _WINDOW_WIDTH)) ** 2, 0.0))


_ALONG_U, _ALONG_V, _GRADIENT_WEIGHTS = _gradients()
_WINDOW_SPECTRUM = _window_spectrum()


def describe_patches(
    levels: list[Grey], points: FloatArray, scale: FloatArray, angle: FloatArray
) -> NDArray[np.float32]:
    """Descriptors (N, 64) of unit length at points (N, 2) of a pyramid; of no contrast: zeros.

    ``scale`` (N,) is the s of the paper, pixels, ``angle`` (N,) the orientation, radians.
    """
    descriptors = np.empty((len(points), 4 * _CELLS**2), np.float32)
    for start in range(0, len(points), _DESCRIBED_AT_ONCE):
        part = slice(start, start + _DESCRIBED_AT_ONCE)
        patches = sample_patches(
            levels, points[part], scale[part] / _SUPERSAMPLING, angle[part], _SUPERSAMPLING * (_SIDE + 1)
        )
        descriptors[part] = _describe(_shrink(patches))
    return descriptors


def _shrink(patches: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Sums over squares of s, shape (N, 21, 21)."""
    n, side, _ = patches.shape
    k = _SUPERSAMPLING
    rows = patches.reshape(n, side // k, k, side).sum(axis=2, dtype=np.int16)
    shrunk: NDArray[np.int16] = rows.reshape(n, side // k, side // k, k).sum(axis=3, dtype=np.int16)
    return shrunk.astype(np.float32)


def _describe(patches: NDArray[np.float32]) -> NDArray[np.float32]:
    """Descriptors of patches (N, 21, 21)."""
    # Haar wavelets of side 2s, at steps of s.
    down = patches[:, 1:] + patches[:, :-1]
    du = (down[:, :, 1:] - down[:, :, :-1]) * _RESPONSE_WEIGHTS
    right = patches[:, :, 1:] + patches[:, :, :-1]
    dv = (right[:, 1:] - right[:, :-1]) * _RESPONSE_WEIGHTS
    parts = np.stack([du, dv, np.abs(du), np.abs(dv)]).reshape(4, -1, _CELLS, _SAMPLES, _CELLS, _SAMPLES)
    cells: NDArray[np.float32] = np.moveaxis(parts.sum(axis=3).sum(axis=4), 0, -1).reshape(len(patches), -1)
    norm: NDArray[np.float32] = np.sqrt((cells**2).sum(axis=1, keepdims=True))
    return np.divide(cells, norm, out=np.zeros_like(cells), where=norm > 0)


_PLACE = np.arange(_SIDE) - (_SIDE - 1) / 2
_RESPONSE_WEIGHTS = np.exp(-(_PLACE[:, None] ** 2 + _PLACE**2) / (2 * _RESPONSE_SIGMA**2)).astype(np.float32)
"""Gaussian weight of each response, (20, 20)."""


def detect_surf(grey: Grey) -> Detection:
    """Find the blobs of an image, which are oriented when they are described."""
    levels = pyramid(grey, _OCTAVES + 3)
    blobs = refine(levels, find_blobs(grey, _THRESHOLD, _OCTAVES, _LAYERS))

    def describe(chosen: NDArray[np.intp]) -> Features:
        some = blobs.take(chosen)
        angle = orientations(levels, some.points, some.scale)
        descriptors = describe_patches(levels, some.points, some.scale, angle)
        return Features(some.points, descriptors, some.size, angle, some.response, some.laplacian_sign, kind="surf")

    return Detection(blobs.points, blobs.size, blobs.response, describe)
