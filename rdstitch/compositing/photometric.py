"""The photometric model: by what the samples of each image are multiplied, so that all have one exposure.

Light ``L`` gives the sample ``v = full ((1 + b) L^(1/p) - b)``: sRGB above its toe for ``b`` = 0.055, any power law,
and so also raw light, for ``b`` = 0. A factor on the light is then a factor ``q`` on ``v + b``, whatever the power, and

    log(v + b) = log q_i + a1 r² + a2 r⁴ + a3 r⁶ + f_i(u, v) + log(light of that point of the plane)

is linear in all unknowns: ``q_i`` per image and channel, the vignetting ``a`` of the lens over the distance r from
the distortion centre, and a smooth field ``f_i`` per image.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, Float32Array, FloatArray, IntArray
from rdstitch.compositing.lattice import LATTICE_STEPS, interpolated
from rdstitch.compositing.warp import Geometry
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.local_alignment.field import nodes_around

# The correction is smooth: it is computed at this spacing, canvas pixels, and interpolated.
_LATTICE = LATTICE_STEPS[0]
# From here on, as a share of the full range, brightened samples are compressed instead of clipped.
KNEE = 0.75
_ROWS = 128  # that are corrected at a time
DEPTHS = {"uint8": cv2.CV_8U, "uint16": cv2.CV_16U, "float32": cv2.CV_32F}


@dataclass(frozen=True, eq=False)
class Exposure:
    """What every image's samples are multiplied by: ``v' = q (v + b) - b``."""

    offset: float  # ``b``, share of the full range
    log_gain: FloatArray  # (N, C): log of what image i is brighter by than the average
    # (3,): coefficients of r², r⁴, r⁶ in log(v + b); r in half diagonals from the distortion centre
    vignetting: FloatArray = field(default_factory=lambda: np.zeros(3))
    # (N, B, B, C), or (0, 0, 0, 0) without one: smooth remainder on a grid over each image (rows, columns), log of what
    # the image is brighter by there
    fields: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0, 0)))
    # brightest corrected sample, share of the full range: what is brightened is compressed, so that nothing up to there
    # becomes full scale but full scale itself; 1: it is clipped
    white: float = 1.0
    # rms_before, rms_after: robust difference between overlapping images, share of the full range
    rms_before: float = 0.0
    rms_after: float = 0.0

    def __post_init__(self) -> None:
        """Refuse factors that are NaN, which would silently become black."""
        if not all(np.isfinite(part).all() for part in (self.log_gain, self.vignetting, self.fields, self.white)):
            raise ArgumentError("exposure is not finite")

    def part(self, images: Sequence[int]) -> "Exposure":
        """The same for some of the images."""
        chosen = list(images)
        fields = self.fields[chosen] if self.fields.size else self.fields
        return replace(self, log_gain=self.log_gain[chosen], fields=fields)

    def smooth_part(self, index: int, camera: Camera, points: FloatArray) -> FloatArray:
        """Vignetting and field at measured pixels (..., 2), log units, shape (..., 1) or (..., C)."""
        r2 = squared_radius(camera, points)
        log = (r2 * (self.vignetting[0] + r2 * (self.vignetting[1] + r2 * self.vignetting[2])))[..., None]
        if self.fields.size:
            nodes, shares = bilinear_weights(camera, points, self.fields.shape[1])
            values = self.fields[index].reshape(-1, self.fields.shape[3])
            log = log + (values[nodes] * shares[..., None]).sum(axis=-2)
        return np.asarray(log, dtype=np.float64)

    def correct(self, index: int, geometry: Geometry, pixels: AnyArray) -> AnyArray:
        """Resampled pixels (h, w, C) of image ``index``, as if all were exposed alike.

        In the type of the pixels. Each depends on nothing but itself: every box gives the same, bit for bit.
        """
        gain = np.exp(-self.log_gain[index]).astype(np.float32)
        if not (self.vignetting.any() or self.fields.size):
            return pixels if (gain == 1).all() else self._apply(pixels, [gain], [self._compression(gain)])
        nodes = self._smooth_nodes(index, geometry) * gain
        compression = self._compression(nodes)
        rates = _planes(compression, geometry) if compression.any() else []
        return self._apply(pixels, _planes(nodes, geometry), rates)

    def factors(self, index: int, geometry: Geometry) -> Float32Array:
        """What samples of image ``index`` are multiplied by, (h, w, C), before highlights are compressed."""
        gain = np.exp(-self.log_gain[index]).astype(np.float32)
        return _joined(_planes(self._smooth_nodes(index, geometry) * gain, geometry))

    def _apply(self, pixels: AnyArray, factors: list[Any], rates: list[Any]) -> AnyArray:
        """``q (v + b) - b``, compressed above the knee; one array for all channels, or one plane a channel."""
        full = np.float32(full_scale(pixels.dtype))
        offset, knee = np.float32(self.offset) * full, np.float32(KNEE) * full
        depth = DEPTHS[pixels.dtype.name]
        done = np.empty_like(pixels)
        flat = done.reshape(len(done), -1)

        def part(arrays: list[Any], rows: slice) -> Any:
            # Planes are joined by OpenCV: numpy is slow along an axis of three.
            return arrays[0] if arrays[0].ndim == 1 else _joined([plane[rows] for plane in arrays])

        # A few rows at a time: what is computed in between stays in the processor's cache.
        for top in range(0, len(pixels), _ROWS):
            rows = slice(top, top + _ROWS)
            values: Any = pixels[rows] + offset
            values *= part(factors, rows)
            if self.white <= 1.0 or not rates:
                # Rounded and clipped to the type; the type stubs lack scalars.
                cv2.subtract(values.reshape(len(values), -1), float(offset), flat[rows], dtype=depth)  # type: ignore[call-overload]
                continue
            values -= offset
            excess = np.maximum(values - knee, np.float32(0.0))
            values -= excess
            rate = part(rates, rows) * (np.float32(1.0) / full)
            values += excess / (np.float32(1.0) + rate * excess)
            cv2.subtract(values.reshape(len(values), -1), 0.0, flat[rows], dtype=depth)  # type: ignore[call-overload]
        return done

    def _compression(self, gain: Float32Array) -> Float32Array:
        """How fast samples above the knee approach full scale: what is full scale before the gain stays so after it.

        ``w`` above the knee becomes ``w / (1 + c w)``; 0 where the gain does not brighten.
        """
        white = np.clip(gain * np.float32(1.0 + self.offset) - np.float32(self.offset), 1.0, np.float32(self.white))
        return np.asarray((white - 1) / (np.float32(1.0 - KNEE) * (white - np.float32(KNEE))), dtype=np.float32)

    def _smooth_nodes(self, index: int, geometry: Geometry) -> Float32Array:
        """What vignetting and field are made up for by, at nodes around a box (m, n, 1 or C)."""
        camera = geometry.warp.camera
        width, height = camera.image_size
        points = geometry.lattice.nodes(geometry.box, _LATTICE).astype(np.float64)
        # Outside the image only mirrored content is corrected; the model must not run away there.
        points = np.clip(points, -0.5, (width - 0.5, height - 0.5))
        return np.exp(-self.smooth_part(index, camera, points)).astype(np.float32)


def no_exposure(count: int, channels: int) -> Exposure:
    """Leaves every sample as it is."""
    return Exposure(0.0, np.zeros((count, channels)))


def full_scale(dtype: np.dtype[Any]) -> float:
    """Largest sample; 1 for floating point."""
    return float(np.iinfo(dtype).max) if dtype.kind == "u" else 1.0


def squared_radius(camera: Camera, points: FloatArray) -> FloatArray:
    """Squared distance from the distortion centre, half diagonals."""
    return np.asarray((camera.normalize(points) ** 2).sum(axis=-1), dtype=np.float64)


def bilinear_weights(camera: Camera, points: FloatArray, side: int) -> tuple[IntArray, FloatArray]:
    """Interpolation on a grid of ``side`` x ``side`` nodes over an image: four nodes (..., 4) and their shares."""
    return nodes_around((np.asarray(points) + 0.5) / camera.image_size * (side - 1), (side, side))


def _planes(nodes: Float32Array, geometry: Geometry) -> list[Float32Array]:
    """Values at nodes around a box (m, n, C), interpolated to its pixels, a plane (h, w) a channel."""
    return [interpolated(nodes[..., k], geometry.box, _LATTICE) for k in range(nodes.shape[2])]


def _joined(planes: list[Float32Array]) -> Float32Array:
    """Planes (h, w) as one array (h, w, C)."""
    joined = np.asarray(cv2.merge(planes), dtype=np.float32)
    return joined.reshape(*planes[0].shape, len(planes))
