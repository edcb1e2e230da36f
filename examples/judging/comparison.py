"""How well a mosaic agrees with the true plane, measured on the image: the stitcher's own numbers are not used."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from examples.judging.fitting import FITS, apply, fit_similarity, quantile
from examples.judging.patches import patch_displacements
from rdstitch.arrays import Float32Array, FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.synthetic.textures import ImageTexture, Texture

_ROUNDS = 5
# A transform that moves no patch by more than this, px, will not change any more.
_SETTLED = 0.02
_FEATURES = 4000
_FEATURE_PIXELS = 1_500_000
# Matches that agree with the first rough homography to this share of the mosaic's size are used to place it.
_ROUGH_AGREEMENT = 0.04
_MIN_MATCHES = 12


@dataclass(frozen=True)
class PlaneComparison:
    """A mosaic beside the true plane.

    ``transform``: mosaic px to texels, of the kind asked for; NaN where the mosaic shows nothing of the plane; shape
    (3, 3). ``residual``: from where the transform puts the plane to where the mosaic shows it, px of the mosaic; NaN
    for patches that do not look like the plane anywhere near; shape (P, 2).
    """

    transform: FloatArray
    center: FloatArray  # centres of the mosaic's patches that have texture, px; shape (P, 2)
    residual: FloatArray
    texels_per_pixel: float  # size of a mosaic px on the plane, in the middle of the mosaic
    coverage: float  # share of the reachable plane that the mosaic shows; NaN if what is reachable was not given

    @property
    def error(self) -> FloatArray:
        """Length of the residuals (P,), px of the mosaic; inf for patches that were not found."""
        length = np.linalg.norm(self.residual, axis=1)
        return np.where(np.isfinite(length), length, np.inf)

    @property
    def median(self) -> float:
        """Median error, px of the mosaic; inf for a mosaic that shows nothing of the plane."""
        return quantile(self.error, 0.5) if len(self.center) else np.inf

    @property
    def percentile95(self) -> float:
        """95 % of the errors are not above this, px of the mosaic; inf if more than 5 % of the patches are wrong."""
        return quantile(self.error, 0.95) if len(self.center) else np.inf


def compare_with_plane(
    mosaic: NDArray[Any],
    plane: Texture,
    *,
    model: str = "similarity",
    reachable: NDArray[np.bool_] | None = None,
    start: ArrayLike | None = None,
    search: int = 16,
) -> PlaneComparison:
    """Lay a mosaic on the true plane and measure how far each part of it is from where it belongs.

    The mosaic is placed roughly by feature matches, or by ``start``. Then, until it
    settles: the plane is drawn in the mosaic's place, patches of the mosaic are looked for in it
    (:func:`examples.judging.patches.patch_displacements`), and the transform that minimises the sum of their squared
    distances is found anew. In the first round patches more than three times the median away do not take part in the
    fit, afterwards all do that were found.

    ``mosaic``: uint8 or uint16; RGB with an optional alpha; shape (h, w), (h, w, 3) or (h, w, 4). ``plane``: held in
    memory once as a grey image. ``model``: "similarity" or "homography": what the mosaic may differ by from the plane.
    ``reachable``: which texels the images show, for the coverage; see :meth:`Sequence.reachable`. Two texels at its
    border do not count. ``start``: mosaic px to texels, right to within ``search``; shape (3, 3). ``search``: see
    :func:`examples.judging.patches.patch_displacements`. Raises :class:`ArgumentError` when the mosaic has another
    shape or type.
    """
    grey, filled = grey_and_filled(mosaic)
    width, height = plane.size
    truth = _grey(plane.region(0, 0, width, height))
    placed = _place_by_features(grey, filled, truth) if start is None else np.asarray(start, dtype=np.float64)
    if placed is None:
        return _nothing(0.0 if reachable is not None else np.nan)
    for turn in range(_ROUNDS):
        drawn, inside = _drawn_over(truth, placed, grey.shape)
        moves = patch_displacements(grey, drawn, filled & inside, search)
        used = moves.found
        if turn == 0 and used.any():
            length = np.linalg.norm(np.nan_to_num(moves.displacement), axis=1)
            used = used & (length <= max(1.0, 3.0 * float(np.median(length[used]))))
        if used.sum() < 4:
            return _nothing(0.0 if reachable is not None else np.nan)
        # The mosaic shows at ``center`` what the drawn plane shows at ``center + displacement``.
        on_plane = apply(placed, moves.center + np.nan_to_num(moves.displacement))
        transform = FITS[model](moves.center[used], on_plane[used])
        moved = apply(np.linalg.inv(transform), apply(placed, moves.center)) - moves.center
        placed = transform
        if turn > 0 and np.abs(moved).max() < _SETTLED:
            break
    residual = moves.center - apply(np.linalg.inv(transform), on_plane)
    residual[~moves.found] = np.nan
    covered = np.nan if reachable is None else coverage(filled, transform, reachable)
    return PlaneComparison(transform, moves.center, residual, _texels_per_pixel(transform, grey.shape), covered)


def coverage(filled: NDArray[np.bool_], transform: ArrayLike, reachable: NDArray[np.bool_]) -> float:
    """Share of the reachable texels that a mosaic shows.

    ``filled``: which px of the mosaic are filled; shape (h, w). ``transform``: mosaic px to texels; shape (3, 3).
    ``reachable``: which texels the images show. Two texels at its border do not count: whether an image shows them is a
    matter of rounding.
    """
    inner = cv2.erode(reachable.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=(0.0,)) > 0
    if not inner.any():
        return np.nan
    height, width = reachable.shape
    shown = cv2.warpPerspective(
        filled.astype(np.uint8), np.asarray(transform, dtype=np.float64), (width, height), flags=cv2.INTER_NEAREST
    )
    return float((shown[inner] > 0).mean())


def sharpness(image: Float32Array, reference: Float32Array, where: NDArray[np.bool_]) -> float:
    """Detail of an image in units of the detail of another one that shows the same, both grey in [0, 1].

    Detail is the root mean square of the Laplacian of Gaussian (σ = 1 px) in units of the standard deviation of the
    image blurred by σ = 4 px: it takes no notice of gain and offset, but noise counts as detail.
    """

    def detail(grey: Float32Array) -> float:
        fine = cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 1.0), cv2.CV_32F)
        coarse = cv2.GaussianBlur(grey, (0, 0), 4.0)
        return float(np.sqrt(np.mean(fine[where] ** 2)) / np.std(coarse[where]))

    return detail(image) / detail(reference)


def plane_under(plane: Texture, transform: ArrayLike, size: tuple[int, int]) -> tuple[Float32Array, NDArray[np.bool_]]:
    """The true plane as a perfect mosaic of a given size (width, height) shows it: grey (h, w), and where there is any.

    ``transform`` is from mosaic px to texels.
    """
    width, height = plane.size
    truth = _grey(plane.region(0, 0, width, height))
    return _drawn_over(truth, np.asarray(transform, dtype=np.float64), (size[1], size[0]))


def _drawn_over(
    truth: Float32Array, transform: FloatArray, shape: tuple[int, ...]
) -> tuple[Float32Array, NDArray[np.bool_]]:
    """The plane in the mosaic's place, low-passed as far as the mosaic is coarser, and where there is any plane."""
    scale = _texels_per_pixel(transform, shape)
    if scale > 1.0:
        truth = np.asarray(cv2.GaussianBlur(truth, (0, 0), 0.4 * scale), dtype=np.float32)
    size = (shape[1], shape[0])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    drawn = cv2.warpPerspective(truth, transform, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    whole = np.full(truth.shape, 255, dtype=np.uint8)
    inside = cv2.warpPerspective(whole, transform, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP) == 255
    return np.asarray(drawn, dtype=np.float32), np.asarray(inside, dtype=np.bool_)


def _texels_per_pixel(transform: FloatArray, shape: tuple[int, ...]) -> float:
    """Square root of the area on the plane of the px in the middle of the mosaic."""
    x, y = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    here, right, down = apply(transform, np.array([(x, y), (x + 1.0, y), (x, y + 1.0)]))
    return float(np.sqrt(np.abs(np.linalg.det(np.stack([right - here, down - here])))))


def _place_by_features(grey: Float32Array, filled: NDArray[np.bool_], truth: Float32Array) -> FloatArray | None:
    """A rough similarity from mosaic px to texels, or None where there is nothing in common.

    Matches that agree only roughly take part on purpose: a mosaic that has drifted should be laid on the plane as a
    whole, not by the part of it that is right.
    """
    a, b = matches(grey, filled, truth)
    if len(a) < _MIN_MATCHES:
        return None
    rough, mask = cv2.findHomography(a, b, cv2.RANSAC, 8.0, maxIters=5000, confidence=0.9999)
    if rough is None or mask.sum() < _MIN_MATCHES:
        return None
    distance = np.linalg.norm(apply(rough, a) - b, axis=1)
    agreed = distance < _ROUGH_AGREEMENT * max(grey.shape)
    return fit_similarity(a[agreed], b[agreed])


def matches(grey: Float32Array, filled: NDArray[np.bool_], truth: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Places (N, 2) of a mosaic and of the truth that look alike."""
    (points1, descriptors1), (points2, descriptors2) = features(grey, filled), features(truth, None)
    if min(len(descriptors1), len(descriptors2)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    best = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors1, descriptors2, k=2)
    pairs = [(m[0].queryIdx, m[0].trainIdx) for m in best if m[0].distance < 0.75 * m[1].distance]
    one, other = np.array(pairs, dtype=int).reshape(-1, 2).T
    return points1[one], points2[other]


def features(grey: Float32Array, mask: NDArray[np.bool_] | None) -> tuple[FloatArray, NDArray[np.float32]]:
    """SIFT points in px and descriptors, from an image reduced to a moderate size."""
    factor = min(1.0, float(np.sqrt(_FEATURE_PIXELS / grey.size)))
    size = (max(1, round(grey.shape[1] * factor)), max(1, round(grey.shape[0] * factor)))
    small = np.rint(cv2.resize(grey, size, interpolation=cv2.INTER_AREA) * 255.0).astype(np.uint8)
    where = None if mask is None else cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    keypoints, descriptors = cv2.SIFT.create(nfeatures=_FEATURES).detectAndCompute(small, where)
    if not keypoints:
        return np.empty((0, 2)), np.empty((0, 128), dtype=np.float32)
    points = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
    at_full_size = (points + 0.5) / (np.array(size) / (grey.shape[1], grey.shape[0])) - 0.5
    return at_full_size, np.asarray(descriptors, dtype=np.float32)


def grey_and_filled(mosaic: NDArray[Any]) -> tuple[Float32Array, NDArray[np.bool_]]:
    """Grey levels in [0, 1] and which px are filled."""
    if mosaic.ndim not in (2, 3) or (mosaic.ndim == 3 and mosaic.shape[2] not in (3, 4)):
        raise ArgumentError(f"a mosaic has shape (h, w), (h, w, 3) or (h, w, 4), not {mosaic.shape}")
    if mosaic.dtype not in (np.uint8, np.uint16):
        raise ArgumentError(f"a mosaic is uint8 or uint16, not {mosaic.dtype}")
    colours = mosaic if mosaic.ndim == 2 else mosaic[:, :, :3]
    if mosaic.ndim == 3 and mosaic.shape[2] == 4:
        filled = mosaic[:, :, 3] > 0
    else:
        lit = (colours if colours.ndim == 2 else colours.max(axis=2)) > 0
        filled = cv2.morphologyEx(lit.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    height, width = mosaic.shape[:2]
    return _grey(ImageTexture(colours).region(0, 0, width, height)), filled


def _grey(image: Float32Array) -> Float32Array:
    """Luma of RGB (h, w, 3), or the only channel of (h, w, 1); shape (h, w)."""
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), dtype=np.float32)


def _nothing(covered: float) -> PlaneComparison:
    """A mosaic in which nothing of the plane can be recognised."""
    none = np.empty((0, 2))
    return PlaneComparison(np.full((3, 3), np.nan), none, none, np.nan, covered)
