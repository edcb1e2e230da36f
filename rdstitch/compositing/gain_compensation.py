"""Gain compensation and vignetting correction: images agree where they overlap, and keep their own brightness.

Two images of one point of the plane differ by gain, vignetting and a smooth field, which are linear in the logarithm
(:mod:`rdstitch.compositing.photometric`): robust least squares over the cells that two images show, of gains and
vignetting first, and then of the fields. What differs for other reasons (parallax, people, the header of a page) is no
evidence of brightness, however much of it there is that agrees with itself: weights redescend to 0 (Tukey's biweight)
around the median of each overlap, and a correction is made only where it explains the overlaps better than none.

Gains alone carry the automatic exposure of one end of a flight to the other, where bright ground is then burnt out.
With "balanced", fields tend to the brightness of each region's own images instead, as a photographer would leave it.
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
from rdstitch.compositing.boxes import cut
from rdstitch.compositing.composite_options import ExposureMethod
from rdstitch.compositing.photometric import Exposure, bilinear_weights, full_scale, no_exposure, squared_radius
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.compositing.survey import Survey, SurveyTile
from rdstitch.geometry.camera import Camera
from rdstitch.system.late_imports import sparse

# Along the longest side of an image or an overlap, and of all overlaps together: of thousands, each needs fewer.
_CELLS, _MAX_CELLS = 16, 150_000
# Integer samples outside this part of the range are clipped or mostly noise.
_DARKEST, _BRIGHTEST = 0.02, 0.97


@dataclass(frozen=True)
class Cells:
    """Cells that two images show."""

    pair: IntArray  # (M,): index of the overlap, ascending
    images: IntArray  # (2, M)
    points: FloatArray  # (2, M, 2): middle of the cell, measured pixels of either image
    values: FloatArray  # (2, M, C): mean samples, share of the full range
    # (2, M), bool: where an image is burnt out: its light is what the samples say, or more. Other cells hold no
    # clipped sample
    clipped: BoolArray
    overlap: "sparse.csr_array"  # (N, N): what two images have in common, share of the smaller one

    @property
    def clear(self) -> BoolArray:
        """Cells (M,) where neither image is burnt out."""
        return np.asarray(~self.clipped.any(axis=0))

    def by_image(self) -> Iterator[tuple[int, int, IntArray]]:
        """Side (0 or 1), image, and its cells."""
        for side, images in enumerate(self.images):
            order = np.argsort(images, kind="stable")
            for cells in np.split(order, np.flatnonzero(np.diff(images[order])) + 1):
                yield side, int(images[cells[0]]), cells


def compare_overlaps(survey: Survey) -> Cells | None:
    """Compare all images that lie over each other; None where no two show the same."""
    pairs, count = survey.pairs(), len(survey.tiles)
    areas = [0 if tile is None else np.count_nonzero(tile.inside) for tile in survey.tiles]
    light = {k: _light(tile) for k, tile in enumerate(survey.tiles) if tile is not None}
    shares, means_of_pairs = np.zeros(len(pairs)), []
    for index, (i, j) in enumerate(pairs.tolist()):
        a, b, box, seen = survey.overlap(i, j)
        shares[index] = np.count_nonzero(seen) / min(areas[i], areas[j])
        side = max(2, round(max(*a.inside.shape, *b.inside.shape) / _CELLS))
        lit = [cut(light[k], tile.box, box) for k, tile in ((i, a), (j, b))]
        layers = [*(cut(tile.pixels, tile.box, box) for tile in (a, b)), *((each > 1)[..., None] for each in lit)]
        for which in filter(np.any, (lit[0] * lit[1] == 1, lit[0] * lit[1] > 1)):
            means = _cell_means(which, layers, side)
            means[:, :2] += box[:2]
            means_of_pairs.append((np.full(len(means), index), means))
    pair = np.concatenate([which for which, _ in means_of_pairs]) if means_of_pairs else np.zeros(0, dtype=np.intp)
    if not len(pair):
        return None
    kept = np.s_[:: -(-len(pair) // _MAX_CELLS)]
    pair, means = pair[kept], np.concatenate([means for _, means in means_of_pairs])[kept]
    full = next(full_scale(tile.pixels.dtype) for tile in survey.tiles if tile is not None)
    values = np.moveaxis(means[:, 2:-2].reshape(len(means), 2, -1), 1, 0) / full
    overlap = sparse.csr_array((shares, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    clipped, points = means[:, -2:].T > 0.5, np.empty((2, len(pair), 2))
    cells = Cells(pair, pairs[pair].T, points, values, clipped, sparse.csr_array(overlap + overlap.T))
    for end, image, chosen in cells.by_image():
        points[end, chosen] = survey.warps[image].source_points(*means[chosen, :2].T)
    known = np.isfinite(points).all(axis=(0, 2))
    parts = (cells.images[:, known], points[:, known], values[:, known], clipped[:, known])
    return Cells(pair[known], *parts, cells.overlap)


def _light(tile: SurveyTile) -> NDArray[np.uint8]:
    """Which pixels (h, w) say how bright the scene is: 1; 2 where they are clipped, and 0 where they say nothing."""
    integer, full = tile.pixels.dtype.kind == "u", full_scale(tile.pixels.dtype)
    darkest, brightest = (_DARKEST * full, _BRIGHTEST * full) if integer else (0.0, np.inf)
    low, high = (reduce(extreme, np.moveaxis(tile.pixels, -1, 0)) for extreme in (np.minimum, np.maximum))
    return np.asarray((tile.inside & (low > darkest)).astype(np.uint8) << (high > brightest))


def _cell_means(which: BoolArray, values: Sequence[NDArray[Any]], side: int) -> FloatArray:
    """Mean x, y (pixels of the box) and values (h, w, K) of every cell of which more than half counts, (M, 2 + K...).

    As products with matrices of ones and zeros, which are many times faster than sums along short axes.
    """
    rows, columns = (
        np.asarray(np.arange(n) // side == np.arange(-(-n // side))[:, None], np.float32) for n in which.shape
    )
    down, across = (cells * np.arange(cells.shape[1], dtype=np.float32) for cells in (rows, columns))
    weight = which.astype(np.float32)
    count, x, y = (a @ weight @ b.T for a, b in ((rows, columns), (rows, across), (down, columns)))
    used = count > side**2 / 2
    means = [x[used], y[used]]
    for part in values:
        # OpenCV masks, and NumPy's product sums, all channels at once.
        chosen = cv2.copyTo(part.view(np.uint8) if part.dtype == np.bool_ else part, which.view(np.uint8))
        along = (rows @ chosen.reshape(len(chosen), -1).astype(np.float32)).reshape(len(rows), which.shape[1], -1)
        means.append((columns @ along)[used])
    return np.column_stack(means) / count[used][:, None].astype(np.float64)


_SRGB_OFFSET = 0.055
# How well the gains of two images can explain their overlap, and how far gains stray (log units): keeps long chains
# from drifting. The last where the camera has written its exposure down: tone curves and apertures are not exact.
_PAIR_SIGMA, _GAIN_SIGMA, _EXIF_SIGMA = 0.02, 0.5, 0.15
# Power of the light that samples follow, for the prior: sRGB above its toe, or raw light.
_SRGB_POWER = 2.4
_VIGNETTING_SIGMA, _VIGNETTING_RANGE = 1.0, (0.15, 1.25)
_NODES = 7  # of a field, along each side of an image
_CELL_SIGMA = 0.03  # how well fields can explain the means of a cell, log units
# How far an image may stray from its own brightness, or, with gains that hold, from these (log units), and how much a
# field may rise, and bend, from one side of an image to the other. Brightness follows the images' own over a
# distance of the first by the third, in images.
_OWN_SIGMA, _FIELD_SIGMA = 0.02, 0.3
_RISE_SIGMA, _BEND_SIGMA = 0.1, 0.5
_TUKEY = 3.0  # standard deviations from which on an error counts for nothing: much of an overlap may be other content
_VISIBLE = 0.004  # log units, a grey level of a light sample: differences below are as good as none
_ROUNDS = 6
# A model with more freedom must explain the data better by this share to be taken.
_MIN_RELATIVE_GAIN = 0.05
# From here on, as a share of the full range, brightened samples are compressed instead of clipped.
_KNEE = 0.75
_MEDIAN_SAMPLES = 10_000  # of all images together
# Residual, as a share of the right side, and decimals that are kept: both far below a grey level.
_TOLERANCE, _MAX_STEPS, _DECIMALS = 1e-4, 3000, 5

_Prior = tuple["sparse.csr_array", FloatArray, int]
"""Precision (K, K), its product with what is expected (K, C), and how many unknowns an image has."""


def estimate_exposure(survey: Survey, images: Sequence[PlacedImage], method: ExposureMethod = "balanced") -> Exposure:
    """Estimate what makes images agree where they overlap, with the median brightness of the set kept.

    Parameters
    ----------
    images : sequence of PlacedImage
        The distortion centre is the centre of the vignetting, and the exposure that the camera wrote down is a weak
        prior of the gain.
    method : str
        "gain": one factor per image and channel, and one vignetting for all. "blocks": also a smooth field per
        image. "balanced": gains and fields that stay near the images' own brightness at large scale, and nothing
        is clipped.

    Returns
    -------
    Exposure
        Without any correction where none makes images agree better.
    """
    present, cells = [tile for tile in survey.tiles if tile is not None], compare_overlaps(survey)
    integer = any(tile.pixels.dtype.kind == "u" for tile in present)
    if cells is None or not cells.clear.any():
        return no_exposure(len(images), present[0].pixels.shape[2] if present else 1)
    responses = [_Differences.of(cells, b) for b in ((_SRGB_OFFSET, 0.0) if integer else (0.0,))]
    fits = [(*_fit(data, images), data) for data in responses]
    exposure, errors, data = min(fits, key=lambda fit: fit[0].rms_after)
    cameras = [image.camera for image in images]
    if method != "gain":
        fields, errors = _fit_fields(cells, errors, cameras, exposure.log_gain, balanced=method == "balanced")
        exposure = replace(exposure, fields=fields, rms_after=data.misfit(errors))
    if exposure.rms_after > (1.0 - _MIN_RELATIVE_GAIN) * exposure.rms_before:
        return no_exposure(*exposure.log_gain.shape)
    exposure = replace(exposure, knee=_KNEE if method == "balanced" and integer else 1.0)
    return _with_median_kept(exposure, survey, cameras)


@dataclass(frozen=True)
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

    def misfit(self, errors: FloatArray) -> float:
        """Geometric mean of what is left, share of the full range: content that differs hardly counts."""
        floor = _VISIBLE * float(np.median(self.cells.values))
        size = np.hypot(np.abs(errors).max(axis=1) * self.level, floor)
        return float(np.exp(np.log(size[self.cells.clear]).mean()))


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
    # Clipped samples say nothing of gains, and a pair counts as one measurement however many cells it has.
    clear = cells.clear
    weight = clear / (np.bincount(cells.pair, clear)[cells.pair].clip(1.0) * _PAIR_SIGMA**2)
    both = sparse.diags_array(np.concatenate([precision, np.full(extra, _VIGNETTING_SIGMA**-2)]))
    expected = np.concatenate([precision * mean, np.zeros(extra)])[:, None].repeat(values.shape[1], axis=1)
    return _fit_robustly(cells, sparse.csr_array(design), weight, values, (sparse.csr_array(both), expected, 1))


def _fit_fields(
    cells: Cells, values: FloatArray, cameras: Sequence[Camera], log_gain: FloatArray, *, balanced: bool
) -> tuple[FloatArray, FloatArray]:
    """Fields (N, B, B, C) beside gains and vignetting, and the errors (M, C)."""
    (rows, channels), nodes = values.shape, _NODES**2
    columns, entries = np.empty((rows, 2, 4), dtype=np.int32), np.empty((rows, 2, 4))
    for end, image, chosen in cells.by_image():
        places, shares = bilinear_weights(cameras[image], cells.points[end, chosen], _NODES)
        columns[chosen, end], entries[chosen, end] = image * nodes + places, (1 - 2 * end) * shares
    shape = (rows, len(cameras) * nodes)
    design = sparse.csr_array((entries.ravel(), columns.ravel(), 8 * np.arange(rows + 1, dtype=np.int32)), shape=shape)
    # What one image alone is brighter by is to vanish: neighbours count by the share that they have in common.
    around = cells.overlap + sparse.eye_array(len(cameras))
    wanted = -(around @ log_gain) / around.sum(axis=1)[:, None] if balanced else np.zeros_like(log_gain)
    near = (_OWN_SIGMA if balanced else _FIELD_SIGMA) ** -2 / nodes
    block = _evenness() + near * np.eye(nodes)
    precision = sparse.csr_array(sparse.kron(sparse.eye_array(len(cameras)), block))
    prior = precision, near * np.repeat(wanted, nodes, axis=0), nodes
    nodes_values, errors = _fit_robustly(cells, design, np.full(rows, _CELL_SIGMA**-2), values, prior)
    return nodes_values.reshape(len(cameras), _NODES, _NODES, channels), errors


def _evenness() -> FloatArray:
    """Precision of the nodes of one image: fields rise and bend little."""
    total, one = np.zeros((_NODES**2, _NODES**2)), np.eye(_NODES)
    for order, sigma in ((1, _RISE_SIGMA), (2, _BEND_SIGMA)):
        step = np.diff(one, order, axis=0) * (_NODES - 1) ** order
        for both in (np.kron(step, one), np.kron(one, step)):
            total += both.T @ both / (sigma**2 * len(both))
    return total


def _fit_robustly(
    cells: Cells, design: "sparse.csr_array", weight: FloatArray, values: FloatArray, prior: _Prior
) -> tuple[FloatArray, FloatArray]:
    """Solution (K, C) of ``design x = values`` (M, C) and the errors, by iteratively reweighted least squares."""
    clear = cells.clear
    errors, solution = (
        values - _medians(values, cells.pair, clear)[cells.pair],
        np.zeros((design.shape[1], values.shape[1])),
    )
    for _ in range(_ROUNDS):
        size = np.abs(errors).max(axis=1)
        scale = max(1.4826 * float(np.median(size[clear])), _VISIBLE)
        robust = (1.0 - (size / (_TUKEY * scale)) ** 2).clip(0.0) ** 2
        # A burnt-out sky is as bright as its samples or brighter, and must not end in a step either.
        darker = np.stack([errors.mean(axis=1), -errors.mean(axis=1)]) < 0.0
        robust[(cells.clipped & darker).any(axis=0)] = 1.0
        solution = _solve(design, robust * weight, values, prior, solution)
        errors, before = values - design @ solution, errors
        if np.abs(errors - before).max() < _VISIBLE:
            break
    return np.round(solution, _DECIMALS), errors


def _solve(
    design: "sparse.csr_array", weight: FloatArray, values: FloatArray, prior: _Prior, start: FloatArray
) -> FloatArray:
    """Weighted least squares with a prior, by conjugate gradients, in memory that grows with the number of images.

    They are preconditioned by the inverse of the part of each image.

    The columns are solved side by side: a product with the matrix is most of a step, and one serves them all.
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
    x, left = start, right - normal @ start
    enough = _TOLERANCE**2 * (right**2).sum(axis=0)
    direction, previous, ones = np.zeros_like(x), np.ones(x.shape[1]), np.ones(len(x))
    for _ in range(_MAX_STEPS):
        going = ones @ left**2 > enough
        if not going.any():
            break
        better = (inverse @ left.reshape(-1, block, x.shape[1])).reshape(x.shape)
        now = ones @ (left * better)
        direction = better + now / previous * direction
        along = normal @ direction
        step = np.where(going, now, 0.0) / np.where(going, ones @ (direction * along), 1.0)
        x, left, previous = x + step * direction, left - step * along, np.where(going, now, 1.0)
    return x


def _medians(values: FloatArray, pair: IntArray, which: BoolArray) -> FloatArray:
    """Median of the values (M, C) of each pair, of those chosen (P, C); 0 where there are none."""
    medians = np.zeros((pair[-1] + 1, values.shape[1]))
    pair, values = pair[which], values[which]
    start = np.flatnonzero(np.diff(pair, prepend=-1))
    middle = start + np.diff(start, append=len(pair)) // 2
    # Sorted as fractions of a number that is the pair's: many times faster than indirectly, by two keys.
    low, span = values.min(), max(2.0 * float(np.ptp(values)), 1e-12)
    ordered = np.sort((values - low).T / span + pair, axis=1)[:, middle]
    medians[pair[start]] = ((ordered - pair[start]) * span + low).T
    return medians


def _with_median_kept(exposure: Exposure, survey: Survey, cameras: Sequence[Camera]) -> Exposure:
    """Gains with a common factor that leaves the median of all samples where it was."""
    before, after = [], []
    area = sum(np.count_nonzero(tile.inside) for tile in survey.tiles if tile is not None)
    # A grid: so many pixels counted row by row would lie in few columns.
    step = max(1, round(math.sqrt(area / _MEDIAN_SAMPLES)))
    for index, tile in enumerate(survey.tiles):
        if tile is not None:
            y, x = step * np.array(np.nonzero(tile.inside[::step, ::step]))
            points = survey.warps[index].source_points(x + float(tile.box[0]), y + float(tile.box[1]))
            log = exposure.log_gain[index] + exposure.smooth_part(index, cameras[index], points)
            light = tile.pixels[y, x] / full_scale(tile.pixels.dtype) + exposure.offset
            before.append(light.mean(axis=1))
            after.append((light * np.exp(-log)).mean(axis=1))
    common = np.log(np.nanmedian(np.concatenate(after)) / np.median(np.concatenate(before)))
    return replace(exposure, log_gain=exposure.log_gain + common)
