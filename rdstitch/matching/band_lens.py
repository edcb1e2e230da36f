"""The lens that took another band, by what images of both show: phase correlation of patches, and one fit of all.

Bands of a rig are taken at one moment from one place by lenses side by side. To first order one image is then a
homography of the other for the whole flight, at the usual distance, with a distortion of its own. Contrast differs, and
may be reversed: what is compared is where it is strong.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.errors import InputError
from rdstitch.features.patch_shifts import Edges, coarse_shift, edges_of, patch_shifts
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import from_plane, to_plane
from rdstitch.inputs.source import Source
from rdstitch.robust.posterior import MODEL_ERROR
from rdstitch.system.late_imports import optimize

_MAX_IMAGES = 8  # that are compared
_AGREEING = 0.002  # diagonals of the image: patches that show a common shift
_ENOUGH = 0.3  # of the patches must agree for a shift to be one
_ELSEWHERE = 0.01  # diagonals between images of one flight: parallax, and triggers that are not quite at one time
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class BandLens:
    """How another lens beside the registered one sees."""

    homography: FloatArray  # (3, 3): undistorted normalized coordinates of the registered image to those of the band
    distortion: float  # what the band's λ has more
    shift: float  # median distance of what the band shows from where the registered image has it, pixels
    error: float  # what is left of it

    @property
    def is_same(self) -> bool:
        """Whether it is the lens that took the registered images, as far as can be told."""
        return self.shift < max(MODEL_ERROR, self.error)

    def camera(self, camera: Camera) -> Camera:
        """The band's camera beside a registered one."""
        return replace(camera, distortion=camera.distortion + self.distortion)


def band_lens(
    pairs: Mapping[int, tuple[Source, Source]], report: Callable[[int, int], None] = lambda done, total: None
) -> BandLens | None:
    """The lens of a band from registered images and those that take their place, by numbers.

    None where nothing is known of it, since the images show nothing in common, as masks do. Raises InputError where
    images were evidently not taken from the same places.
    """
    chosen = evenly_spaced(len(pairs), _MAX_IMAGES).tolist()
    compared = [list(pairs.values())[k] for k in chosen]
    compared = [pair for pair in compared if pair[0].camera.image_size == pair[1].camera.image_size]
    if not compared:
        return None
    edges = []
    for done, pair in enumerate(compared):
        report(done, len(compared))
        edges.append((edges_of(pair[0].read().pixels), edges_of(pair[1].read().pixels)))
    coarse = np.array([coarse_shift(*each) for each in edges])
    sure = [k for k, each in enumerate(edges) if _is_shifted(*each, coarse[k])]
    if not sure:
        return None
    _refuse_other_places([compared[k] for k in sure], coarse[sure])
    expected: Callable[[FloatArray], FloatArray] = partial(np.add, np.median(coarse[sure], axis=0))
    camera, lens = compared[0][0].camera, None
    for _ in range(_ROUNDS):
        lens = _fit(camera, [patch_shifts(*edges[k], expected) for k in sure])
        if lens is None:
            return None
        expected = partial(_seen_by_band, camera, lens.homography, lens.distortion)
    return lens


def _seen_by_band(camera: Camera, homography: FloatArray, distortion: float, points: FloatArray) -> FloatArray:
    """Pixels (N, 2) of a registered image as the band has them."""
    other = replace(camera, distortion=camera.distortion + distortion)
    return from_plane(other, np.eye(3), to_plane(camera, homography, points))


def _fit(camera: Camera, shifts: Sequence[FloatArray]) -> BandLens | None:
    """The lens that most patches of all images agree with; None where few do."""
    points, others = np.concatenate(shifts, axis=1)
    if len(points) < 9:
        return None
    near = _AGREEING * math.hypot(*camera.image_size)
    start = np.zeros(9)
    start[[2, 5]] = np.median(others - points, axis=0) / camera.scale

    def seen(parameters: FloatArray) -> FloatArray:
        homography = np.eye(3) + np.append(parameters[:8], 0.0).reshape(3, 3)
        return _seen_by_band(camera, homography, float(parameters[8]), points)

    def residuals(parameters: FloatArray) -> FloatArray:
        return np.asarray(np.nan_to_num(seen(parameters) - others, nan=1e3).ravel())

    result = optimize.least_squares(residuals, start, loss="cauchy", f_scale=near / 3.0, x_scale=0.01, max_nfev=50)
    off = np.linalg.norm(result.fun.reshape(-1, 2), axis=1)
    agreeing = off < near
    if agreeing.mean() < _ENOUGH:
        return None
    moved = np.linalg.norm(seen(result.x) - points, axis=1)
    homography = np.eye(3) + np.append(result.x[:8], 0.0).reshape(3, 3)
    return BandLens(homography, float(result.x[8]), float(np.median(moved)), float(np.median(off[agreeing])))


def _is_shifted(first: Edges, second: Edges, shift: FloatArray) -> bool:
    """Whether patches of the second image agree that it shows what the first does by that much (2,) shifted."""
    points, others = patch_shifts(first, second, partial(np.add, shift))
    away = np.linalg.norm(others - points - shift, axis=1)
    return len(away) > 0 and float((away < 3.0 * _AGREEING * math.hypot(*first.shape)).mean()) > _ENOUGH


def _refuse_other_places(compared: Sequence[tuple[Source, Source]], shifts: FloatArray) -> None:
    """Refuse images that show the same as the registered ones, but each shifted by something else."""
    off = np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1)
    worst = int(np.argmax(off))
    registered, given = compared[worst]
    if off[worst] > _ELSEWHERE * math.hypot(*registered.camera.image_size):
        others = [other for _, other in compared if other is not given]
        further = np.linalg.norm(shifts[worst] - np.median(np.delete(shifts, worst, axis=0), axis=0))
        whom, which = (f"{others[0].name} does", "one of them") if len(others) == 1 else ("the others do", "it")
        raise InputError(
            f"{given.path}: shows what {registered.name} does {further:.0f} pixels further off than {whom}: "
            f"{which} was not taken from the same place; stitch these images separately"
        )
