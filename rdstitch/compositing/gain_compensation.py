"""Equal brightness: gain per picture and channel, one vignetting for all, and a smooth field per picture.

Light ``L`` gives the sample ``v = full ((1 + b) L^(1/p) - b)``: sRGB above its toe for ``b`` = 0.055, any power law,
and so also raw light, for ``b`` = 0. A factor on the light is then a factor ``q`` on ``v + b``, whatever the power, and

    log(v + b) = log q_i + a1 r² + a2 r⁴ + a3 r⁶ + f_i(u, v) + log(light of that point of the plane)

is linear in all unknowns: ``q_i`` per picture and channel, the vignetting ``a`` of the lens over the distance r from
the distortion centre, and the block field ``f_i``. Two pictures of one point differ by the first terms alone. Which
``b`` the pictures follow is decided by the residuals.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing.boxes import Box, Float32Array, cut, intersection
from rdstitch.compositing.lattice import LATTICE_STEPS, interpolated
from rdstitch.compositing.survey import Survey, SurveyTile
from rdstitch.compositing.warp import Geometry

_SRGB_OFFSET = 0.055
# Samples outside this part of the range are clipped or mostly noise.
_DARKEST, _BRIGHTEST = 0.02, 0.97
_SAMPLES_PER_PAIR, _LARGEST_SAMPLES = 800, 600_000
_FEWEST_SAMPLES = 30
# How well two pictures' brightness can agree, and how far gains stray (log units): keeps long chains from drifting.
_PAIR_SIGMA, _GAIN_SIGMA = 0.02, 0.5
_VIGNETTING_SIGMA, _VIGNETTING_RANGE = 1.0, (0.15, 1.25)
_BLOCKS = 5
_BLOCK_SIGMA, _BLOCK_BEND_SIGMA = 0.3, 0.1
_HUBER = 1.345
_ROUNDS = 6
# A model with more freedom must explain the data better by this share to be taken.
_WORTHWHILE = 0.02
# The correction is smooth: it is computed at this spacing, canvas px, and interpolated.
_LATTICE = LATTICE_STEPS[0]
_ROWS = 128  # that are corrected at a time
_DEPTHS = {"uint8": cv2.CV_8U, "uint16": cv2.CV_16U, "float32": cv2.CV_32F}


@dataclass(frozen=True)
class Exposure:
    """What every picture's samples are multiplied by: ``v' = q (v + b) - b``.

    Attributes
    ----------
    offset : float
        ``b``, share of the full range.
    log_gain : ndarray of shape (N, C)
        log of what picture i is brighter by than the average.
    vignetting : ndarray of shape (3,)
        Coefficients of r², r⁴, r⁶ in log(v + b); r in half diagonals from the distortion centre.
    blocks : ndarray of shape (N, B, B), or (N, 0, 0)
        Smooth remainder on a grid over each picture (rows, columns).
    rms_before, rms_after : float
        Robust difference between overlapping pictures, share of the full range.
    """

    offset: float
    log_gain: FloatArray
    vignetting: FloatArray = field(default_factory=lambda: np.zeros(3))
    blocks: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))
    rms_before: float = 0.0
    rms_after: float = 0.0

    def smooth_part(self, index: int, camera: Camera, points: FloatArray) -> FloatArray:
        """Vignetting and block field at measured px (..., 2), log units."""
        r2 = _radius2(camera, points)
        log = r2 * (self.vignetting[0] + r2 * (self.vignetting[1] + r2 * self.vignetting[2]))
        if self.blocks.size:
            nodes, shares = _block_weights(camera, points)
            log = log + (self.blocks[index].ravel()[nodes] * shares).sum(axis=-1)
        return np.asarray(log, dtype=np.float64)

    def correct(self, index: int, geometry: Geometry, pixels: NDArray[Any]) -> NDArray[Any]:
        """Resampled pixels (h, w, C) of picture ``index``, as if all were exposed alike.

        In the type of the pixels. Depends, px by px, on nothing but the px: every box gives the same, bit for bit.
        """
        gain = np.exp(-self.log_gain[index]).astype(np.float32)
        smooth = self._smooth_level(index, geometry) if self.vignetting.any() or self.blocks.size else None
        if smooth is None and (gain == 1).all():
            return pixels
        offset = np.float32(self.offset * full_scale(pixels.dtype))
        depth = _DEPTHS[pixels.dtype.name]
        done = np.empty_like(pixels)
        flat = done.reshape(len(done), -1)
        # A few rows at a time: what is computed in between stays in the processor's cache.
        for top in range(0, len(pixels), _ROWS):
            rows = slice(top, top + _ROWS)
            values: Any = pixels[rows] + offset
            # Planes are joined by OpenCV: numpy is slow along an axis of three.
            values *= gain if smooth is None else _joined([smooth[rows] * factor for factor in gain])
            # Rounded and clipped to the type; the stubs know no scalars.
            cv2.subtract(values.reshape(len(values), -1), float(offset), flat[rows], dtype=depth)  # type: ignore[call-overload]
        return done

    def _smooth_level(self, index: int, geometry: Geometry) -> Float32Array:
        """What vignetting and block field are made up for by, on a box (h, w)."""
        camera = geometry.warp.camera
        width, height = camera.image_size
        points = geometry.lattice.nodes(geometry.box, _LATTICE).astype(np.float64)
        # Outside the picture only mirrored content is corrected; the model must not run away there.
        points = np.clip(points, -0.5, (width - 0.5, height - 0.5))
        nodes = np.exp(-self.smooth_part(index, camera, points)).astype(np.float32)
        return interpolated(nodes, geometry.box, _LATTICE)


def _joined(planes: list[Float32Array]) -> Float32Array:
    """Planes (h, w) as one array (h, w, C)."""
    joined = np.asarray(cv2.merge(planes), dtype=np.float32)
    return joined.reshape(*planes[0].shape, len(planes))


def full_scale(dtype: np.dtype[Any]) -> float:
    """Largest sample; 1 for floating point."""
    return float(np.iinfo(dtype).max) if dtype.kind == "u" else 1.0


def no_exposure(count: int, channels: int) -> Exposure:
    """Leaves every sample as it is."""
    return Exposure(0.0, np.zeros((count, channels)))


def estimate_exposure(survey: Survey, cameras: Sequence[Camera], blocks: bool = False) -> Exposure:
    """Least squares over all overlaps, robust against what differs for other reasons (parallax, people).

    Parameters
    ----------
    survey : Survey
    cameras : sequence of Camera
        Their distortion centre is the centre of the vignetting.
    blocks : bool
        Whether each picture also gets a smooth field of its own.

    Returns
    -------
    Exposure
        Without any correction where no pictures overlap.
    """
    present = [tile for tile in survey.tiles if tile is not None]
    channels = present[0].pixels.shape[2] if present else 1
    samples = _collect(survey, cameras)
    if samples is None:
        return no_exposure(len(cameras), channels)
    offsets = (_SRGB_OFFSET, 0.0) if present[0].pixels.dtype.kind == "u" else (0.0,)
    best = min((_fit_light(samples, b, len(cameras)) for b in offsets), key=lambda fit: fit.rms_after)
    return _with_blocks(best, samples, cameras) if blocks else best


@dataclass(frozen=True)
class _Samples:
    """Points that two pictures see: picture, weight, value (share of full), px and r² of either; S of each.

    They are sorted by pair; ``start`` is where those of each begin.
    """

    start: NDArray[np.intp]
    first: NDArray[np.intp]
    second: NDArray[np.intp]
    share: FloatArray
    value1: FloatArray
    value2: FloatArray
    point1: FloatArray
    point2: FloatArray
    radius1: FloatArray
    radius2: FloatArray


def _collect(survey: Survey, cameras: Sequence[Camera]) -> _Samples | None:
    """Samples from every pair of overlapping pictures, evenly spread."""
    pairs = [
        (i, j, box)
        for i, a in enumerate(survey.tiles)
        if a is not None
        for j, b in enumerate(survey.tiles[:i])
        if b is not None and (box := intersection(a.box, b.box)) is not None
    ]
    limit = max(_FEWEST_SAMPLES, min(_SAMPLES_PER_PAIR, _LARGEST_SAMPLES // max(1, len(pairs))))
    found: list[tuple[Any, ...]] = []
    for i, j, box in pairs:
        a, b = survey.tiles[i], survey.tiles[j]
        assert a is not None
        assert b is not None
        inside = cut(a.inside, a.box, box) & cut(b.inside, b.box, box)
        where = np.flatnonzero(inside)
        if len(where) < _FEWEST_SAMPLES:
            continue
        where = where[:: max(1, len(where) // limit)]
        va, vb = (_values(tile, box, where) for tile in (a, b))
        usable = ((np.minimum(va, vb) > _DARKEST) & (np.maximum(va, vb) < _BRIGHTEST)).all(axis=1)
        if a.pixels.dtype.kind != "u":
            usable = ((va > 0) & (vb > 0)).all(axis=1)
        where, va, vb = where[usable], va[usable], vb[usable]
        if len(where) < _FEWEST_SAMPLES:
            continue
        y, x = (index.astype(np.float64) for index in np.unravel_index(where, inside.shape))
        pa, pb = (survey.warps[k].source_points(x + box[0], y + box[1]) for k in (i, j))
        found.append((i, j, va, vb, pa, pb, _radius2(cameras[i], pa), _radius2(cameras[j], pb)))
    if not found:
        return None
    counts = [len(f[2]) for f in found]
    first, second = (np.repeat([f[k] for f in found], counts) for k in (0, 1))
    # A pair counts as one measurement however many samples it has.
    share = np.repeat([1.0 / n for n in counts], counts)
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return _Samples(start, first, second, share, *(np.concatenate([f[k] for f in found]) for k in range(2, 8)))


def _values(tile: SurveyTile, box: Box, where: NDArray[np.intp]) -> FloatArray:
    """Samples as share of the full range, (S, C)."""
    pixels = cut(tile.pixels, tile.box, box).reshape(-1, tile.pixels.shape[2])
    return pixels[where].astype(np.float64) / full_scale(tile.pixels.dtype)


def _radius2(camera: Camera, points: FloatArray) -> FloatArray:
    """Squared distance from the distortion centre, half diagonals."""
    return np.asarray((camera.normalize(points) ** 2).sum(axis=-1), dtype=np.float64)


def _fit_light(samples: _Samples, offset: float, count: int) -> Exposure:
    """Gains, and vignetting where it explains the data better."""
    gains, vignetted = (_fit(samples, offset, count, vignetting) for vignetting in (False, True))
    return vignetted if vignetted.rms_after < (1.0 - _WORTHWHILE) * gains.rms_after else gains


def _fit(samples: _Samples, offset: float, count: int, vignetting: bool) -> Exposure:
    """Gains and vignetting for one response of the camera, by iteratively reweighted least squares."""
    difference = np.log(samples.value1 + offset) - np.log(samples.value2 + offset)
    grey = difference.mean(axis=1)
    level = np.sqrt((samples.value1.mean(axis=1) + offset) * (samples.value2.mean(axis=1) + offset))
    powers = [samples.radius1**k - samples.radius2**k for k in (1, 2, 3)]
    radial = np.stack(powers, axis=1) if vignetting else np.zeros((len(grey), 0))
    robust = np.ones(len(grey))
    before = _robust_rms(grey * level, samples.share)
    for _ in range(_ROUNDS):
        weight = robust * samples.share / _PAIR_SIGMA**2
        solution = _solve(samples, weight, grey[:, None], radial, count)
        residual = grey - (solution[samples.first] - solution[samples.second])[:, 0] - radial @ solution[count:, 0]
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-4)
        robust = 1.0 / np.maximum(1.0, np.abs(residual) / (_HUBER * scale))
    coefficients = np.zeros(3)
    if vignetting:
        coefficients = solution[count:, 0]
        profile = np.exp(np.stack([np.linspace(0, 1, 20) ** k for k in (1, 2, 3)], axis=1) @ coefficients)
        if not ((profile > _VIGNETTING_RANGE[0]) & (profile < _VIGNETTING_RANGE[1])).all():
            return Exposure(offset, np.zeros((count, difference.shape[1])), rms_before=before, rms_after=np.inf)
    flat = difference - (radial @ solution[count:])
    gains = _solve(samples, robust * samples.share / _PAIR_SIGMA**2, flat, np.zeros((len(grey), 0)), count)
    after = _robust_rms((flat - gains[samples.first] + gains[samples.second]).mean(axis=1) * level, samples.share)
    return Exposure(offset, gains, coefficients, rms_before=before, rms_after=after)


def _robust_rms(errors: FloatArray, share: FloatArray) -> float:
    """Mean absolute error over pairs."""
    return float((np.abs(errors) * share).sum() / share.sum())


def _solve(samples: _Samples, weight: FloatArray, values: FloatArray, radial: FloatArray, count: int) -> FloatArray:
    """Weighted least squares of ``g_first - g_second + radial a = values``; shape (count + K, C)."""
    extra = radial.shape[1]
    # All samples of a pair have the same gains: what they say of these is summed first.
    ends = samples.first[samples.start], samples.second[samples.start]
    total, gain_radial, gain_value = (
        np.add.reduceat(weight[:, None] * v, samples.start, axis=0) for v in (np.ones((len(weight), 1)), radial, values)
    )
    between = sparse.csr_array(
        (np.repeat([1.0, -1.0], len(total)), (np.concatenate(ends), np.tile(np.arange(len(total)), 2))),
        shape=(count, len(total)),
    )
    border = sparse.csr_array(between @ gain_radial)
    gains = between @ sparse.diags_array(total[:, 0]) @ between.T
    bends = sparse.csr_array((weight[:, None] * radial).T @ radial)
    prior = sparse.diags_array([_GAIN_SIGMA**-2] * count + [_VIGNETTING_SIGMA**-2] * extra)
    normal = sparse.block_array([[gains, border], [border.T, bends]]) + prior
    right = np.concatenate([between @ gain_value, (weight[:, None] * radial).T @ values])
    return np.asarray(spsolve(normal.tocsc(), right), dtype=np.float64).reshape(count + extra, -1)


def _block_weights(camera: Camera, points: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Bilinear interpolation on the picture's block grid: four nodes (..., 4) and their shares (..., 4)."""
    width, height = camera.image_size
    place = (np.asarray(points) + 0.5) / (width, height) * (_BLOCKS - 1)
    place = np.clip(place, 0.0, _BLOCKS - 1.0)
    cell = np.minimum(place.astype(np.intp), _BLOCKS - 2)
    x, y = np.moveaxis(place - cell, -1, 0)
    node = cell[..., 1] * _BLOCKS + cell[..., 0]
    nodes = np.stack([node, node + 1, node + _BLOCKS, node + _BLOCKS + 1], axis=-1)
    return nodes, np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=-1)


def _with_blocks(base: Exposure, samples: _Samples, cameras: Sequence[Camera]) -> Exposure:
    """Add a smooth field per picture that explains what gain and vignetting leave over."""
    b, count, size = base.offset, len(cameras), _BLOCKS**2
    residual = (np.log(samples.value1 + b) - np.log(samples.value2 + b)).mean(axis=1)
    residual -= (base.log_gain[samples.first] - base.log_gain[samples.second]).mean(axis=1)
    powers = np.stack([samples.radius1**k - samples.radius2**k for k in (1, 2, 3)], axis=1)
    residual -= powers @ base.vignetting
    level = np.sqrt((samples.value1.mean(axis=1) + b) * (samples.value2.mean(axis=1) + b))
    parts = []
    for sign, picture, points in ((1.0, samples.first, samples.point1), (-1.0, samples.second, samples.point2)):
        nodes, shares = np.empty((len(points), 4), dtype=np.intp), np.empty((len(points), 4))
        for k in np.unique(picture):
            chosen = picture == k
            nodes[chosen], shares[chosen] = _block_weights(cameras[k], points[chosen])
        parts.append((picture[:, None] * size + nodes, sign * shares))
    columns, entries = (np.concatenate([p[k] for p in parts], axis=1) for k in (0, 1))
    rows = np.repeat(np.arange(len(residual)), 8)
    design = sparse.csr_array((entries.ravel(), (rows, columns.ravel())), shape=(len(residual), count * size))
    prior = sparse.kron(sparse.eye_array(count), _block_prior()).tocsr()
    robust = np.ones(len(residual))
    solution = np.zeros(count * size)
    for _ in range(_ROUNDS):
        weighted = design.T.multiply(robust * samples.share * size / _PAIR_SIGMA**2).tocsr()
        solution = np.asarray(spsolve((weighted @ design + prior).tocsc(), weighted @ residual))
        left = residual - design @ solution
        scale = max(1.4826 * float(np.median(np.abs(left))), 1e-4)
        robust = 1.0 / np.maximum(1.0, np.abs(left) / (_HUBER * scale))
    fields = solution.reshape(count, _BLOCKS, _BLOCKS)
    after = _robust_rms(left * level, samples.share)
    return Exposure(b, base.log_gain, base.vignetting, fields, base.rms_before, after)


def _block_prior() -> sparse.csr_array:
    """Fields are small, and bend little: precision matrix of one picture's nodes."""
    bend = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(_BLOCKS - 2, _BLOCKS))
    one = sparse.eye_array(_BLOCKS)
    both = sparse.vstack([sparse.kron(bend, one), sparse.kron(one, bend)])
    return sparse.csr_array(both.T @ both / _BLOCK_BEND_SIGMA**2 + sparse.eye_array(_BLOCKS**2) / _BLOCK_SIGMA**2)
