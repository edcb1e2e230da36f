"""Blobs that box filters found, confirmed and moved by the derivatives that the boxes stand for.

Box filters are not isotropic. When the image turns by 30° their maxima move by half a pixel (median) and a third of
them vanish. So the determinant of the Hessian is taken once more, with Gaussians on a few samples around each. The
paper leaves this out; it costs a tenth of the time and halves the error of the correspondences, and with it λ's.
"""

from dataclasses import replace

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.features.surf.hessian import Blobs, vertex
from rdstitch.features.surf.patches import Grey, apply_kernels, integer_kernels, sample_patches

_SIGMA = 1.43  # units of s: the box filters' maximum over scale is at s = σ / 1.43 for a Gaussian blob of σ pixels
_SPACING = 0.5  # of samples, units of s
_SAMPLES = 24  # along each side of a patch
_STEP = 0.5  # between the places compared, units of s
_FACTOR = 1.2  # between the scales compared
_MAX_OFFSET = 1.5  # that a blob may move, in steps
_BLOBS = 2048  # worked on at a time


def refine(levels: list[Grey], blobs: Blobs) -> Blobs:
    """Move blobs to the maxima of the Gaussian determinant of the Hessian, and drop those that have none near."""
    parts = [
        _refine(levels, blobs.take(np.arange(i, min(i + _BLOBS, len(blobs))))) for i in range(0, len(blobs), _BLOBS)
    ]
    return Blobs.concatenate(parts) if parts else blobs


def _refine(levels: list[Grey], blobs: Blobs) -> Blobs:
    """One batch of :func:`refine`."""
    patches = sample_patches(levels, blobs.points, blobs.scale * _SPACING, np.zeros(len(blobs)), _SAMPLES)
    uu, vv, uv = np.moveaxis((apply_kernels(patches, _KERNELS) / np.float32(_KERNEL_FACTOR)).reshape(-1, 3, 27), 1, 0)
    determinant = (uu * vv - uv**2).reshape(-1, 3, 3, 3)
    offset, is_maximum = vertex(determinant)
    near = is_maximum & (np.abs(offset) <= _MAX_OFFSET).all(axis=1)
    blobs, offset = blobs.take(near), offset[near]
    return replace(
        blobs,
        points=blobs.points + offset[:, :2] * (_STEP * blobs.scale)[:, None],
        size=blobs.size * _FACTOR ** offset[:, 2],
        response=determinant[near, 1, 1, 1].astype(np.float64),
    )


def _second_derivatives() -> FloatArray:
    """Filters D_uu, D_vv, D_uv, each at 3 scales x 3 rows x 3 columns, shape (pixels, 81), scale-normalized."""
    pixel = (np.arange(_SAMPLES) - (_SAMPLES - 1) / 2) * _SPACING
    sigma = _SIGMA * np.array([1 / _FACTOR, 1.0, _FACTOR])[:, None, None]
    step = np.array([-_STEP, 0.0, _STEP])
    v, u, sigma = (
        np.broadcast_to(axis, (_SAMPLES, _SAMPLES, 3, 3, 3)).reshape(_SAMPLES**2, 27)
        for axis in (pixel[:, None, None, None, None] - step[:, None], pixel[None, :, None, None, None] - step, sigma)
    )
    gauss = np.exp(-(u**2 + v**2) / (2 * sigma**2)) / (2 * np.pi * sigma**2) * _SPACING**2
    filters = [(u**2 / sigma**2 - 1) * gauss, (v**2 / sigma**2 - 1) * gauss, u * v / sigma**2 * gauss]
    # Cut off at the patch's border they would see a constant: take that out.
    return np.hstack([values - gauss * (values.sum(axis=0) / gauss.sum(axis=0)) for values in filters])


_KERNELS, _KERNEL_FACTOR = integer_kernels(_second_derivatives())
