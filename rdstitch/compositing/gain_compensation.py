"""Gain compensation and vignetting correction: images agree where they overlap, and keep their own brightness.

Two images of one point of the plane differ by gain, vignetting and a smooth field, which are linear in the logarithm
(:mod:`rdstitch.compositing.photometric`): robust least squares over the cells that two images show, of gains and
vignetting first, and then of the fields. Content that differs (parallax, people, the header of a page) is no evidence
of brightness, however much of it there is that agrees with itself: a cell counts by how well the patterns of both
images correlate in it, weights redescend to 0 (Tukey's biweight) around the mode of each overlap, and each further
freedom is given only where it explains the overlaps better.

Gains alone carry the automatic exposure of one end of a flight to the other, where bright ground is then burnt out.
With "balanced", the whole then follows the brightness of each region's own images, just as far as that takes.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.compositing.boxes import Float32Array, cut
from rdstitch.compositing.photometric import KNEE, Exposure, bilinear_weights, full_scale, no_exposure, squared_radius
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.compositing.survey import Survey, SurveyTile
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.conjugate_gradients import conjugate_gradients
from rdstitch.options.composite_options import ExposureMethod
from rdstitch.system.late_imports import sparse

# Along the longest side of an image or an overlap, and of all overlaps together: of thousands, each needs fewer.
_CELLS, _MAX_CELLS = 16, 150_000
_SAMPLES = 10  # pixels along each side of a cell that are looked at, at least, where it has so many
# Integer samples outside this part of the range are clipped or mostly noise.
_DARKEST, _BRIGHTEST = 0.02, 0.97


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells that two images show."""

    pair: IntArray  # (M,): index of the overlap, ascending
    images: IntArray  # (2, M)
    points: FloatArray  # (2, M, 2): middle of the cell, measured pixels of either image
    values: FloatArray  # (2, M, C): mean samples, share of the full range
    clipped: BoolArray  # (2, M): where an image is burnt out, in all channels: its light is what they say, or more
    evidence: FloatArray  # (M,): from 0 to 1, how surely both images show the same there
    overlap: "sparse.csr_array"  # (N, N): what two images have in common, share of the smaller one

    @property
    def content(self) -> FloatArray:
        """Weight (M,) of what is the same once gains are known: then plain cells count as much as others."""
        return np.asarray((self.evidence / _PLAIN_COUNTS).clip(max=1.0))

    def darkened(self, errors: FloatArray) -> BoolArray:
        """Cells (M,) where what is burnt out is now darker than the same in the other image.

        A burnt-out sky is as bright as its samples or brighter, and must not end in a step either.
        """
        first = errors.mean(axis=1)
        return np.asarray((self.clipped & (np.stack([first, -first]) < 0.0)).any(axis=0))

    def by_image(self) -> Iterator[tuple[int, int, IntArray]]:
        """Side (0 or 1), image, and its cells."""
        for side, images in enumerate(self.images):
            order = np.argsort(images, kind="stable")
            for cells in np.split(order, np.flatnonzero(np.diff(images[order])) + 1):
                yield side, int(images[cells[0]]), cells


def compare_overlaps(survey: Survey) -> Cells | None:
    """Compare all images that lie over each other; None where no two show the same."""
    pairs, count = survey.pairs(), len(survey.tiles)
    present = {k: tile for k, tile in enumerate(survey.tiles) if tile is not None}
    areas = {k: np.count_nonzero(tile.inside) for k, tile in present.items()}
    light = {k: _light(tile) for k, tile in present.items()}
    grey = {k: _grey(tile.pixels) for k, tile in present.items()}
    shares, means_of_pairs = np.zeros(len(pairs)), []
    for index, (i, j) in enumerate(pairs.tolist()):
        a, b, box, seen = survey.overlap(i, j)
        shares[index] = np.count_nonzero(seen) / min(areas[i], areas[j])
        side = max(2, round(max(*a.inside.shape, *b.inside.shape) / _CELLS))
        step = max(1, side // _SAMPLES)
        compared: list[tuple[NDArray[Any], NDArray[Any]]] = [
            (light[i], light[j]),
            (grey[i], grey[j]),
            (a.pixels, b.pixels),
        ]
        lit, (p, q), colours = (
            [cut(values, tile.box, box)[::step, ::step] for values, tile in zip(both, (a, b), strict=True)]
            for both in compared
        )
        burnt = np.stack([each > 1 for each in lit] + [each > 2 for each in lit], axis=-1)
        moments = np.stack([p, q, p * p, q * q, p * q], axis=-1)
        layers = np.concatenate([*colours, burnt, moments], axis=-1, dtype=np.float32)
        for which in filter(np.any, (lit[0] * lit[1] == 1, lit[0] * lit[1] > 1)):
            means = _cell_means(which, layers, side // step)
            means = means[:: max(1, -(-len(means) * len(pairs) // _MAX_CELLS))]
            means[:, :2] = step * means[:, :2] + box[:2]
            means_of_pairs.append((np.full(len(means), index), means))
    pair = np.concatenate([which for which, _ in means_of_pairs]) if means_of_pairs else np.zeros(0, dtype=np.intp)
    if not len(pair):
        return None
    means = np.concatenate([means for _, means in means_of_pairs])
    full = full_scale(next(iter(present.values())).pixels.dtype)
    values = np.moveaxis(means[:, 2:-9].reshape(len(means), 2, -1), 1, 0) / full
    overlap = sparse.csr_array((shares, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    clipped, points = means[:, -9:-5].T > 0.5, np.empty((2, len(pair), 2))
    evidence = _evidence(means[:, -5:].T, np.asarray(clipped.any(axis=0)))
    cells = Cells(pair, pairs[pair].T, points, values, clipped[2:], evidence, sparse.csr_array(overlap + overlap.T))
    for end, image, chosen in cells.by_image():
        points[end, chosen] = survey.warps[image].source_points(*means[chosen, :2].T)
    known = np.isfinite(points).all(axis=(0, 2))
    parts = (cells.images[:, known], points[:, known], values[:, known], cells.clipped[:, known], evidence[known])
    return Cells(pair[known], *parts, cells.overlap)


def _evidence(moments: FloatArray, clipped: BoolArray) -> FloatArray:
    """How surely both images show the same in cells (M,), from the means of p, q, pp, qq and pq, shape (5, M).

    By the squared correlation of their patterns; where both are plain, or a sample is ``clipped``, they are taken to be
    alike, but count for less than any pattern.
    """
    p, q, pp, qq, pq = moments
    plain = (_PLAIN * float(np.median(moments[:2]))) ** 2
    first, second = (np.maximum(square - mean**2, 0.0) for square, mean in ((pp, p), (qq, q)))
    alike = ((pq - p * q + plain) / np.sqrt((first + plain) * (second + plain))).clip(0.0, 1.0) ** 2
    weaker = np.minimum(first, second)
    patterned = np.where(clipped, 0.0, weaker / (weaker + plain))
    return np.asarray(alike * (patterned + (1.0 - patterned) * _PLAIN_COUNTS))


def _grey(pixels: NDArray[Any]) -> Float32Array:
    """Mean of the channels (h, w), share of the full range."""
    channels = pixels.shape[2]
    weights = np.full(channels, 1.0 / (channels * full_scale(pixels.dtype)), np.float32)
    return np.asarray(pixels @ weights, dtype=np.float32)


def _light(tile: SurveyTile) -> NDArray[np.uint8]:
    """Which pixels (h, w) say how bright the scene is: 1; 2 where a channel is clipped, 4 where all are, 0 for none."""
    integer, full = tile.pixels.dtype.kind == "u", full_scale(tile.pixels.dtype)
    darkest, brightest = (_DARKEST * full, _BRIGHTEST * full) if integer else (0.0, np.inf)
    low, high = (reduce(extreme, np.moveaxis(tile.pixels, -1, 0)) for extreme in (np.minimum, np.maximum))
    clipped = (high > brightest).astype(np.uint8) + (low > brightest)
    return np.asarray((tile.inside & (low > darkest)).astype(np.uint8) << clipped)


def _cell_means(which: BoolArray, values: Float32Array, side: int) -> FloatArray:
    """Mean x, y (pixels of the box) and values (h, w, K) of every cell of which more than half counts, (M, 2 + K).

    As products with matrices of ones and zeros, which are many times faster than sums along short axes.
    """
    rows, columns = (
        np.asarray(np.arange(n) // side == np.arange(-(-n // side))[:, None], np.float32) for n in which.shape
    )
    down, across = (cells * np.arange(cells.shape[1], dtype=np.float32) for cells in (rows, columns))
    weight = which.astype(np.float32)
    count, x, y = (a @ weight @ b.T for a, b in ((rows, columns), (rows, across), (down, columns)))
    used = count > side**2 / 2
    # OpenCV masks, and NumPy's product sums, all channels at once.
    chosen = cv2.copyTo(values, which.view(np.uint8))
    along = (rows @ chosen.reshape(len(chosen), -1)).reshape(len(rows), which.shape[1], -1)
    return np.column_stack([x[used], y[used], (columns @ along)[used]]) / count[used][:, None].astype(np.float64)


_SRGB_OFFSET = 0.055
# How well the gains of two images can explain their overlap, and how far gains stray (log units): keeps long chains
# from drifting. The last where the camera has written its exposure down: tone curves and apertures are not exact.
_PAIR_SIGMA, _GAIN_SIGMA, _EXIF_SIGMA = 0.02, 0.5, 0.15
# Power of the light that samples follow, for the prior: sRGB above its toe, or raw light.
_SRGB_POWER = 2.4
_VIGNETTING_SIGMA, _VIGNETTING_RANGE = 1.0, (0.15, 1.25)
# Of a field, along each side of an image; of more than some 1,000 images fewer, so that the system stays bounded.
_NODES, _MAX_NODES = 7, 50_000
_CELL_SIGMA = 0.03  # how well fields can explain the means of a cell, log units
# How far a field may stray from 0, and rise, and bend, from one side of an image to the other. Where images follow
# their own brightness, they do so to the second figure, and over a distance of that by the third, in images.
_FIELD_SIGMA, _OWN_SIGMA = 0.3, 0.02
_RISE_SIGMA, _BEND_SIGMA = 0.1, 0.5
_TUKEY = 3.0  # standard deviations from which on an error counts for nothing
# The mode of an overlap is sought with this share of its cells: the rest may be other content. Of normal errors, this
# share lies within so many standard deviations.
_CORE, _CORE_SIGMA = 0.3, 0.385
# Deviation within a cell, share of the samples' median, below which a pattern is hardly more than noise; and what a
# cell without any counts beside one with a pattern.
_PLAIN, _PLAIN_COUNTS = 0.01, 0.1
_VISIBLE = 0.004  # log units, a grey level of a light sample: differences below are as good as none
_ROUNDS = 6
# A model with more freedom must explain the data better by this share to be taken.
_MIN_RELATIVE_GAIN = 0.05
# The brightest thousandth may be brightened to where compression leaves three quarters of its contrast; beyond, images
# follow their own brightness.
_BRIGHTEST_SHARE, _MAX_WHITE = 0.999, KNEE + (1.0 - KNEE) / math.sqrt(0.75)
_MEDIAN_SAMPLES = 10_000  # of all images together
# Residual, as a share of the right side, and decimals that are kept: both far below a grey level.
_TOLERANCE, _DECIMALS = 1e-4, 5

_Prior = tuple["sparse.csr_array", FloatArray, int]
"""Precision (K, K), its product with what is expected (K, C), and how many unknowns an image has."""


def estimate_exposure(survey: Survey, images: Sequence[PlacedImage], method: ExposureMethod = "balanced") -> Exposure:
    """Estimate what makes images agree where they overlap, with the median brightness of the set kept.

    The distortion centre is the centre of the vignetting, and the exposure that the camera wrote down is a weak prior
    of the gain. Nothing is corrected where that makes images agree no better.
    """
    present, cells = [tile for tile in survey.tiles if tile is not None], compare_overlaps(survey)
    integer = any(tile.pixels.dtype.kind == "u" for tile in present)
    if cells is None or not cells.evidence.any():
        return no_exposure(len(images), present[0].pixels.shape[2] if present else 1)
    responses = [_Differences.of(cells, b) for b in ((_SRGB_OFFSET, 0.0) if integer else (0.0,))]
    fits = [(*_fit(data, images), data) for data in responses]
    exposure, errors, data = min(fits, key=lambda fit: fit[0].rms_after)
    if exposure.rms_after > (1.0 - _MIN_RELATIVE_GAIN) * exposure.rms_before:
        same = no_exposure(*exposure.log_gain.shape)
        exposure, errors = replace(same, offset=data.offset, rms_before=exposure.rms_before), data.values
    cameras = [image.camera for image in images]
    if method != "gain":
        fields, left = _fit_fields(cells, errors, cameras)
        shown = np.where(cells.darkened(errors), 1.0, cells.content)
        if data.misfit(left, shown) < (1.0 - _MIN_RELATIVE_GAIN) * data.misfit(errors, shown):
            exposure = replace(exposure, fields=fields, rms_after=data.misfit(left))
    if not (exposure.log_gain.any() or exposure.fields.size):
        return no_exposure(*exposure.log_gain.shape)
    if method == "balanced" and integer:
        exposure = _without_burning(exposure, cells, survey, cameras)
    light, log = _samples(exposure, survey, cameras)
    return replace(exposure, log_gain=exposure.log_gain + _common(light, log))


@dataclass(frozen=True, eq=False)
class _Differences:
    """What the first image of each cell is brighter by, log units, for one response of the camera."""

    cells: Cells
    offset: float
    values: FloatArray  # (M, C)
    level: FloatArray  # (M,): share of the full range that one log unit is there

    @classmethod
    def of(cls, cells: Cells, offset: float) -> Self:
        log = np.log(cells.values + offset)
        return cls(cells, offset, log[0] - log[1], np.sqrt((cells.values.mean(axis=-1) + offset).prod(axis=0)))

    def misfit(self, errors: FloatArray, weights: FloatArray | None = None) -> float:
        """Geometric mean of what is left, share of the full range: content that differs hardly counts."""
        floor = _VISIBLE * float(np.median(self.cells.values))
        size = np.hypot(np.abs(errors).max(axis=1) * self.level, floor)
        return float(np.exp(np.average(np.log(size), weights=self.cells.evidence if weights is None else weights)))


def _fit(data: _Differences, images: Sequence[PlacedImage]) -> tuple[Exposure, FloatArray]:
    """Gains, and vignetting where it explains the data better; and the errors."""
    cells, prior = data.cells, _gain_prior(images, data.offset)
    radius2 = np.empty((2, len(data.level)))
    for end, image, chosen in cells.by_image():
        radius2[end, chosen] = squared_radius(images[image].camera, cells.points[end, chosen])
    powers = np.stack([radius2[0] ** k - radius2[1] ** k for k in (1, 2, 3)], axis=1)
    gains, errors = _fit_gains(cells, data.values, powers[:, :0], prior)
    exposure = Exposure(data.offset, gains, rms_before=data.misfit(data.values), rms_after=data.misfit(errors))
    coefficients = _fit_gains(cells, data.values, powers, prior)[0][len(images) :].mean(axis=1)
    gains, flat = _fit_gains(cells, data.values - (powers @ coefficients)[:, None], powers[:, :0], prior)
    profile = np.exp(np.linspace(0.0, 1.0, 20)[:, None] ** (1, 2, 3) @ coefficients)
    possible = profile.min() > _VIGNETTING_RANGE[0] and profile.max() < _VIGNETTING_RANGE[1]
    if possible and (better := data.misfit(flat)) < (1.0 - _MIN_RELATIVE_GAIN) * exposure.rms_after:
        return replace(exposure, log_gain=gains, vignetting=coefficients, rms_after=better), flat
    return exposure, errors


def _gain_prior(images: Sequence[PlacedImage], offset: float) -> tuple[FloatArray, FloatArray]:
    """Expected log gain of each image, and its precision (N,): from the exposures where two or more are known."""
    light = np.array([np.log(p.exposure) if p.exposure and p.exposure > 0.0 else np.nan for p in images])
    known = np.isfinite(light)
    if known.sum() < 2:
        return np.zeros(len(light)), np.full(len(light), _GAIN_SIGMA**-2)
    mean = (light - light[known].mean()) / (_SRGB_POWER if offset else 1.0)
    return np.where(known, mean, 0.0), np.where(known, _EXIF_SIGMA, _GAIN_SIGMA) ** -2.0


def _fit_gains(
    cells: Cells, values: FloatArray, radial: FloatArray, prior: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Gains (N, C) and below them the coefficients of further columns (M, K), and the errors (M, C)."""
    (mean, precision), (rows, extra) = prior, radial.shape
    signed = np.tile([1.0, -1.0], rows), cells.images.T.ravel(), 2 * np.arange(rows + 1)
    design = sparse.hstack([sparse.csr_array(signed, shape=(rows, len(mean))), sparse.csr_array(radial)])
    # A pair counts as one measurement however many cells it has.
    weight = cells.evidence / (np.bincount(cells.pair, cells.evidence)[cells.pair].clip(1.0) * _PAIR_SIGMA**2)
    both = sparse.diags_array(np.concatenate([precision, np.full(extra, _VIGNETTING_SIGMA**-2)]))
    expected = np.concatenate([precision * mean, np.zeros(extra)])[:, None].repeat(values.shape[1], axis=1)
    return _fit_robustly(cells, sparse.csr_array(design), weight, values, (sparse.csr_array(both), expected, 1))


def _fit_fields(cells: Cells, values: FloatArray, cameras: Sequence[Camera]) -> tuple[FloatArray, FloatArray]:
    """Fields (N, B, B, C) beside gains and vignetting, and the errors (M, C)."""
    side, channels = _field_side(len(cameras)), values.shape[1]
    design = _field_design(cells, cameras, side)
    prior = _field_prior(np.zeros((len(cameras), channels)), side, _FIELD_SIGMA)
    weight = cells.content / _CELL_SIGMA**2
    fields, errors = _fit_robustly(cells, design, weight, values, prior, clipped_weight=_CELL_SIGMA**-2)
    return fields.reshape(len(cameras), side, side, channels), errors


def _field_side(count: int) -> int:
    """Nodes of a field along each side of one of so many images."""
    return max(2, min(_NODES, math.isqrt(_MAX_NODES // count)))


def _field_design(cells: Cells, cameras: Sequence[Camera], side: int) -> "sparse.csr_array":
    """What all nodes do to the cells, (M, nodes): four in either image."""
    rows, nodes = len(cells.pair), side**2
    columns, entries = np.empty((rows, 2, 4), dtype=np.int32), np.empty((rows, 2, 4))
    for end, image, chosen in cells.by_image():
        places, shares = bilinear_weights(cameras[image], cells.points[end, chosen], side)
        columns[chosen, end], entries[chosen, end] = image * nodes + places, (1 - 2 * end) * shares
    ends = 8 * np.arange(rows + 1, dtype=np.int32)
    return sparse.csr_array((entries.ravel(), columns.ravel(), ends), shape=(rows, len(cameras) * nodes))


def _field_prior(wanted: FloatArray, side: int, sigma: float) -> _Prior:
    """Fields of means ``wanted`` (N, C), give or take ``sigma``, that rise and bend little."""
    nodes, one = side**2, np.eye(side)
    block = np.eye(nodes) / (sigma**2 * nodes)
    for order, change in ((1, _RISE_SIGMA), (2, _BEND_SIGMA)):
        step = np.diff(one, order, axis=0) * (side - 1) ** order
        for both in (np.kron(step, one), np.kron(one, step)):
            block += both.T @ both / (change**2 * max(1, len(both)))
    precision = sparse.csr_array(sparse.kron(sparse.eye_array(len(wanted)), block))
    return precision, np.repeat(wanted, nodes, axis=0) / (sigma**2 * nodes), nodes


def _without_burning(exposure: Exposure, cells: Cells, survey: Survey, cameras: Sequence[Camera]) -> Exposure:
    """With images that follow their own brightness just as far as it takes to leave contrast in what is bright."""
    light, log = _samples(exposure, survey, cameras)
    unclipped = light.max(axis=1) < _BRIGHTEST + exposure.offset

    def white(log: FloatArray) -> float:
        done = (light * np.exp(-log - _common(light, log))).max(axis=1)[unclipped] - exposure.offset
        return float(np.quantile(done, _BRIGHTEST_SHARE)) if len(done) else 1.0

    if (brightest := white(log)) <= _MAX_WHITE:
        return replace(exposure, white=max(brightest, 1.0))
    # What one image alone is brighter by is to vanish: neighbours count by the share that they have in common.
    around, gains = cells.overlap + sparse.eye_array(len(cameras)), exposure.log_gain + _common(light, log)
    side, shape = _field_side(len(cameras)), gains.shape
    design = _field_design(cells, cameras, side)
    prior = _field_prior(-(around @ gains) / around.sum(axis=1)[:, None], side, _OWN_SIGMA)
    none = np.zeros((len(cells.pair), shape[1]))
    solution = _solve(design, np.full(len(none), _CELL_SIGMA**-2), none, prior, np.zeros((design.shape[1], shape[1])))
    own = np.round(solution, _DECIMALS).reshape(-1, side, side, shape[1])
    along = _samples(replace(exposure, log_gain=np.zeros(shape), vignetting=np.zeros(3), fields=own), survey, cameras)[
        1
    ]
    share = next((s for s in np.linspace(0.0, 1.0, 17)[1:-1] if white(log + s * along) <= _MAX_WHITE), 1.0)
    fields = share * own + (exposure.fields if exposure.fields.size else 0.0)
    return replace(exposure, fields=fields, white=max(white(log + share * along), 1.0))


def _fit_robustly(
    cells: Cells,
    design: "sparse.csr_array",
    weight: FloatArray,
    values: FloatArray,
    prior: _Prior,
    clipped_weight: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Solution (K, C) of ``design x = values`` (M, C) and the errors, by iteratively reweighted least squares."""
    errors = values - _modes(values, cells.pair, cells.evidence)
    solution = np.zeros((design.shape[1], values.shape[1]))
    for _ in range(_ROUNDS):
        size = np.abs(errors).max(axis=1)
        order = np.argsort(size, kind="stable")
        total = np.cumsum(cells.evidence[order])
        scale = max(float(size[order[np.searchsorted(total, _CORE * total[-1])]]) / _CORE_SIGMA, _VISIBLE)
        robust = weight * (1.0 - (size / (_TUKEY * scale)) ** 2).clip(0.0) ** 2
        robust[cells.darkened(errors)] = clipped_weight
        solution = _solve(design, robust, values, prior, solution)
        errors, before = values - design @ solution, errors
        if np.abs(errors - before).max() < _VISIBLE:
            break
    return np.round(solution, _DECIMALS), errors


def _modes(values: FloatArray, pair: IntArray, evidence: FloatArray) -> FloatArray:
    """The mode of the values (M, C) of each cell's pair (M, C), a channel at a time.

    The middle of an interval as long as the shortest that holds a core of the evidence, and that holds the most of it.
    """
    number = np.cumsum(np.diff(pair, prepend=pair[0]) > 0)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    stop = np.append(first[1:], len(pair))
    weight = evidence + 1e-9
    core = _CORE * np.add.reduceat(weight, first)
    modes = np.empty((len(first), values.shape[1]))
    for channel in range(values.shape[1]):
        order = np.lexsort((values[:, channel], number))
        value, total = values[order, channel], np.append(0.0, np.cumsum(weight[order]))
        last = np.searchsorted(total[1:], (total[:-1] + core[number]) * (1.0 - 1e-12))
        length = np.where(last < stop[number], value[np.minimum(last, len(value) - 1)] - value, np.inf)
        longest = np.maximum(np.minimum.reduceat(length, first), _VISIBLE)[number]
        # One ascending line of numbers, on which every pair has a stretch of its own.
        line = value + number * (2.0 * (float(np.ptp(value)) + float(longest.max())))
        end = np.searchsorted(line, line + longest, side="right")
        best = np.lexsort((total[end] - total[:-1], number))[stop - 1]
        sums = np.append(0.0, np.cumsum(weight[order] * value))
        modes[:, channel] = (sums[end[best]] - sums[best]) / (total[end[best]] - total[best])
    return modes[number]


def _solve(
    design: "sparse.csr_array", weight: FloatArray, values: FloatArray, prior: _Prior, start: FloatArray
) -> FloatArray:
    """Weighted least squares with a prior, by conjugate gradients, in memory that grows with the number of images.

    They are preconditioned by the inverse of the part of each image.
    """
    precision, expected, block = prior
    weighted = design.copy()
    weighted.data *= np.repeat(weight, np.diff(design.indptr))
    # No larger than the design, whose rows every step would go through twice otherwise.
    normal = sparse.csr_array(weighted.T @ design + precision)
    right = weighted.T @ values + expected
    entries = normal.tocoo()
    own = entries.row // block == entries.col // block
    row, column = entries.row[own], entries.col[own]
    blocks = np.zeros((len(right) // block, block, block))
    blocks[row // block, row % block, column % block] = entries.data[own]
    inverse = np.linalg.inv(blocks)

    def precondition(left: FloatArray) -> FloatArray:
        return (inverse @ left.reshape(-1, block, left.shape[1])).reshape(left.shape)

    return conjugate_gradients(normal, right, start, precondition, _TOLERANCE)


def _samples(exposure: Exposure, survey: Survey, cameras: Sequence[Camera]) -> tuple[FloatArray, FloatArray]:
    """Samples of all images on a grid, with the offset of the response, and the log of what divides them, (M, C)."""
    lights, logs = [], []
    area = sum(np.count_nonzero(tile.inside) for tile in survey.tiles if tile is not None)
    # A grid: so many pixels counted row by row would lie in few columns.
    step = max(1, round(math.sqrt(area / _MEDIAN_SAMPLES)))
    for index, tile in enumerate(survey.tiles):
        if tile is not None:
            y, x = step * np.array(np.nonzero(tile.inside[::step, ::step]))
            points = survey.warps[index].source_points(x + float(tile.box[0]), y + float(tile.box[1]))
            log = exposure.log_gain[index] + exposure.smooth_part(index, cameras[index], points)
            known = np.isfinite(log).all(axis=1)
            lights.append((tile.pixels[y, x] / full_scale(tile.pixels.dtype) + exposure.offset)[known])
            logs.append(log[known])
    return np.concatenate(lights), np.concatenate(logs)


def _common(light: FloatArray, log: FloatArray) -> float:
    """What is to be added to ``log`` to leave the median of all samples where it was."""
    return float(np.log(np.median((light * np.exp(-log)).mean(axis=1)) / np.median(light.mean(axis=1))))
