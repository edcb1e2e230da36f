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
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.compositing.field_fit import fit_fields, fit_own_brightness
from rdstitch.compositing.gain_fit import MIN_RELATIVE_GAIN, Differences, fit_gain_and_vignetting
from rdstitch.compositing.overlap_cells import BRIGHTEST, Cells, compare_overlaps
from rdstitch.compositing.photometric import KNEE, Exposure, full_scale, no_exposure
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.compositing.survey import Survey
from rdstitch.geometry.camera import Camera
from rdstitch.options.composite_options import ExposureMethod
from rdstitch.system.late_imports import sparse

_SRGB_OFFSET = 0.055
_WHITE_QUANTILE = 0.999  # of the samples, which is the white that is brightened
# Share of the full range up to which white may be brightened, where compression leaves three quarters of its contrast;
# beyond, images follow their own brightness.
_MAX_WHITE = KNEE + (1.0 - KNEE) / math.sqrt(0.75)
_MEDIAN_SAMPLES = 10_000  # of all images together


def estimate_exposure(
    survey: Survey, images: Sequence[PlacedImage], method: ExposureMethod = "balanced", workers: int = 1
) -> Exposure:
    """Estimate what makes images agree where they overlap, with the median brightness of the set kept.

    The distortion centre is the centre of the vignetting, and the exposure that the camera wrote down is a weak prior
    of the gain. Nothing is corrected where that makes images agree no better. ``workers``: threads.
    """
    present, cells = [tile for tile in survey.tiles if tile is not None], compare_overlaps(survey, workers)
    integer = any(tile.pixels.dtype.kind == "u" for tile in present)
    if cells is None or not cells.evidence.any():
        return no_exposure(len(images), present[0].pixels.shape[2] if present else 1)

    def fitted(offset: float) -> tuple[Exposure, FloatArray, Differences]:
        data = Differences.of(cells, offset)
        return (*fit_gain_and_vignetting(data, images), data)

    with ThreadPoolExecutor(workers) as pool:
        fits = list(pool.map(fitted, (_SRGB_OFFSET, 0.0) if integer else (0.0,)))
    exposure, errors, data = min(fits, key=lambda fit: fit[0].rms_after)
    if exposure.rms_after > (1.0 - MIN_RELATIVE_GAIN) * exposure.rms_before:
        same = no_exposure(*exposure.log_gain.shape)
        exposure, errors = replace(same, offset=data.offset, rms_before=exposure.rms_before), data.values
    cameras = [image.camera for image in images]
    if method != "gain":
        fields, left = fit_fields(cells, errors, cameras, workers)
        shown = np.where(cells.darkened(errors), 1.0, cells.content)
        if data.misfit(left, shown) < (1.0 - MIN_RELATIVE_GAIN) * data.misfit(errors, shown):
            exposure = replace(exposure, fields=fields, rms_after=data.misfit(left))
    if not (exposure.log_gain.any() or exposure.fields.size):
        return no_exposure(*exposure.log_gain.shape)
    if method == "balanced" and integer:
        exposure = _without_burning(exposure, cells, survey, cameras, workers)
    light, log = _samples(exposure, survey, cameras)
    return replace(exposure, log_gain=exposure.log_gain + _common(light, log))


def _without_burning(
    exposure: Exposure, cells: Cells, survey: Survey, cameras: Sequence[Camera], workers: int
) -> Exposure:
    """Have images follow their own brightness just as far as it takes to leave contrast in what is bright."""
    light, log = _samples(exposure, survey, cameras)
    unclipped = light.max(axis=1) < BRIGHTEST + exposure.offset

    def white(log: FloatArray) -> float:
        done = (light * np.exp(-log - _common(light, log))).max(axis=1)[unclipped] - exposure.offset
        return float(np.quantile(done, _WHITE_QUANTILE)) if len(done) else 1.0

    if (brightest := white(log)) <= _MAX_WHITE:
        return replace(exposure, white=max(brightest, 1.0))
    # What one image alone is brighter by is to vanish: neighbours count by the share that they have in common.
    around, gains = cells.overlap + sparse.eye_array(len(cameras)), exposure.log_gain + _common(light, log)
    local_fields = fit_own_brightness(cells, -(around @ gains) / around.sum(axis=1)[:, None], cameras, workers)
    local_only = replace(exposure, log_gain=np.zeros(gains.shape), vignetting=np.zeros(3), fields=local_fields)
    _, along = _samples(local_only, survey, cameras)
    amount = next((s for s in np.linspace(0.0, 1.0, 17)[1:-1] if white(log + s * along) <= _MAX_WHITE), 1.0)
    fields = amount * local_fields + (exposure.fields if exposure.fields.size else 0.0)
    return replace(exposure, fields=fields, white=max(white(log + amount * along), 1.0))


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
    """What is to be added to ``log`` to leave the median of all samples but black ones, which no gain moves."""
    before, after = light.mean(axis=1), (light * np.exp(-log)).mean(axis=1)
    lit = (before > 0.0) & (after > 0.0)
    return float(np.log(np.median(after[lit]) / np.median(before[lit]))) if lit.any() else 0.0
