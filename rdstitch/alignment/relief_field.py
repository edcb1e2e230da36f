"""What relief does to a lens: hills are laid under the pictures, and the adjustment answers them.

Relief moves all points of a place together, in every picture that shows it, and a part of that the parameters absorb:
hills as wide as an overlap are fitted by its homography and by λ. What is left over, that the errors of neighbours
agree, shows how high the hills are, and by how much they can have moved λ, if how wide they are is known. Here they are
taken to be of all widths, and equally steep, as most ground roughly is (a power law; Mandelbrot 1975). The answers to
waves of all these widths give both: the agreement that they leave, and how far they move λ.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rdstitch.alignment.linear_response import Fields, LinearResponse
from rdstitch.alignment.link_equations import LinearizedErrors, split_lens
from rdstitch.alignment.motion_models import inverses
from rdstitch.alignment.planarity import neighbours
from rdstitch.alignment.rotation_model import ROTATION
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.division_model import distort, undistort
from rdstitch.radial_homography import project
from rdstitch.robust.loss import ALIGNMENT_WIDTH

_SHORTEST, _LONGEST = 0.5, 6.0
"""Wavelengths, in half diagonals of a picture on the ground: what neighbours show, and what poses absorb whole."""

_WAVES = 32
"""Waves, each as a sine and a cosine."""

_AT_ONCE, _FEW_LINKS = 8, 4000
"""Waves that are answered together; of so few links all of them, with less than 10 kB a link."""

_NOISE_FIELDS = 16
"""Fields of independent errors that show what their absorption leaves of agreement between neighbours."""

_STEP = 1e-4
"""Heights, of differences."""

_ASIDE = 0.3
"""Half diagonals from the middle of a picture, where its size on the ground is measured."""


@dataclass(frozen=True)
class ReliefField:
    """Ground under the pictures of an adjustment.

    Attributes
    ----------
    response : LinearResponse
    """

    response: LinearResponse

    def covariance(self) -> FloatArray:
        """Covariance (S, S) of the shared parameters by relief.

        By relief of the height at which it leaves the agreement of neighbours that was found, beyond that of
        independent errors. These agree less than not at all, since the parameters absorb what they have in common.
        """
        count = len(self.response.normal.gradient_shared)
        common = self._common()
        if common == 0.0:
            return np.zeros((count, count))
        step = _WAVES if len(self.response.adjuster.observations) <= _FEW_LINKS else _AT_ONCE
        answers = [self._answers(self._waves(start, step), 2 * step) for start in range(0, _WAVES, step)]
        agreement = float(np.mean([own for own, _ in answers]))
        moved = np.mean([own for _, own in answers], axis=0)
        covariance: FloatArray = moved * (common / agreement) if agreement > 0.0 else np.zeros((count, count))
        return covariance

    def _common(self) -> float:
        """Mean product of the errors of neighbours, px², beyond what the absorption of independent errors leaves."""
        first, second = self._neighbours
        if not len(first):
            return 0.0
        errors = np.concatenate([part.errors for part in self.response.parts()])
        products = np.einsum("mi,mi->m", errors[first], errors[second])
        power = float((errors[np.unique(np.concatenate([first, second]))] ** 2).mean())
        return max(float(products.mean()) - power * self._answers(_independent, _NOISE_FIELDS)[0], 0.0)

    def _answers(self, fields: Fields, columns: int) -> tuple[float, FloatArray]:
        """Agreement of neighbours, px², that fields leave, and products (S, S) of the steps of the shared parameters.

        Both in the mean over the fields.
        """
        poses, shared = self.response.steps_of(fields, columns)
        first, second = self._neighbours
        agreement = 0.0
        for part in self.response.parts():
            own = slice(*np.searchsorted(first, [part.rows.start, part.rows.stop]).tolist())
            left = fields(part) + self.response.changes(part, poses, shared)
            a, b = (left[rows[own] - part.rows.start] for rows in (first, second))
            agreement += float(np.einsum("mic,mic->", a, b))
        return agreement / (len(first) * columns), shared @ shared.T / columns

    def _waves(self, start: int, count: int) -> Fields:
        """Sines and cosines of some of the waves, from the ``start``-th."""
        waves = _wave_vectors(self._is_turn)[start : start + count] / self._size
        # Equally steep, waves are the higher the longer they are.
        height = 1.0 / np.linalg.norm(waves * self._size, axis=1)

        def fields(part: LinearizedErrors) -> FloatArray:
            place, parallax = self._parallax(part)
            phase = place @ waves.T
            heights = np.concatenate([height * np.cos(phase), height * np.sin(phase)], axis=1)
            field: FloatArray = parallax[:, :, None] * heights[:, None, :]
            return field

        return fields

    @property
    def _is_turn(self) -> bool:
        return self.response.adjuster.model is ROTATION

    @cached_property
    def _neighbours(self) -> tuple[IntArray, IntArray]:
        """Pairs of neighbours, each once, by the first of each."""
        adjusted = self.response.adjusted
        inliers: BoolArray = adjusted.squared <= (ALIGNMENT_WIDTH * adjusted.sigma) ** 2
        pairs = np.sort(np.stack(neighbours(self.response.adjuster.observations, inliers)), axis=0)
        first, second = np.unique(pairs, axis=1)
        return first, second

    @cached_property
    def _back(self) -> FloatArray:
        """Picture-to-plane homographies, or those to directions, (N, 3, 3)."""
        return inverses(self.response.adjusted.matrices.matrices)

    def _places(self, lifted: FloatArray) -> FloatArray:
        """Places (m, 2) on the plane, or directions (m, 3), of homogeneous ones (m, 3)."""
        if not self._is_turn:
            return np.nan_to_num(project(lifted))
        unit: FloatArray = lifted / np.linalg.norm(lifted, axis=1, keepdims=True)
        return np.nan_to_num(unit)

    @cached_property
    def _centres(self) -> FloatArray:
        """What each picture's centre shows, (N, 2 or 3)."""
        return self._places(self._back[:, :, 2])

    @cached_property
    def _sizes(self) -> FloatArray:
        """Of half a diagonal of each picture on the plane, or between directions, (N,)."""
        aside = [self._places(self._back @ np.array([x, y, 1.0])) for x, y in ((_ASIDE, 0.0), (0.0, _ASIDE))]
        away = [np.linalg.norm(places - self._centres, axis=1) / _ASIDE for places in aside]
        sizes: FloatArray = np.maximum((away[0] + away[1]) / 2.0, 1e-12)
        return sizes

    @cached_property
    def _size(self) -> float:
        """Of half a diagonal of most pictures."""
        return float(np.median(self._sizes))

    @cached_property
    def _shifts(self) -> FloatArray:
        """Of the camera away from where it turns, one a picture, (N, 2): any, since nothing is known of them."""
        return np.random.default_rng(0).normal(size=(len(self._back), 2))

    @np.errstate(all="ignore")  # what lies beyond a horizon has no place
    def _parallax(self, part: LinearizedErrors) -> tuple[FloatArray, FloatArray]:
        """The places (m, 2 or 3) of correspondences, and the errors (m, 2), pixels, of ground one unit higher there.

        The unit does not matter, since how high the ground is shows in the errors.
        """
        o, lens = self.response.adjuster.observations, self.response.adjusted.parameters.lens
        link = o.link[part.rows]
        distortion, higher, centre = split_lens(lens)
        flat = undistort(o.points1[part.rows] - centre, distortion, higher)
        lifted = np.column_stack([flat, np.ones(len(flat))])
        place = self._places(np.einsum("mij,mj->mi", self._back[o.image1[link]], lifted))
        moved = [self._moved(place, pictures[link]) for pictures in (o.image1, o.image2)]
        errors = np.einsum("mij,mj->mi", part.by_point1, moved[0]) + np.einsum("mij,mj->mi", part.by_point2, moved[1])
        return place, np.nan_to_num(errors, posinf=0.0, neginf=0.0)

    def _moved(self, place: FloatArray, pictures: IntArray) -> FloatArray:
        """By how much measured points (m, 2) of places move in their pictures (m,) with the height of the ground."""
        if self._is_turn:
            shift: FloatArray = self._shifts[pictures]
            return shift
        lens, matrices = self.response.adjusted.parameters.lens, self.response.adjusted.matrices.matrices[pictures]
        distortion, higher, _ = split_lens(lens)
        away = (place - self._centres[pictures]) / self._sizes[pictures, None]
        ends = []
        for step in (_STEP, -_STEP):
            there = np.column_stack([place + step * self._size * away, np.ones(len(place))])
            ends.append(distort(project(np.einsum("mij,mj->mi", matrices, there)), distortion, higher))
        moved: FloatArray = (ends[0] - ends[1]) / (2.0 * _STEP)
        return moved


def _independent(part: LinearizedErrors) -> FloatArray:
    """Independent errors of standard deviation 1, always the same ones."""
    return np.random.default_rng(part.first).normal(size=(*part.errors.shape, _NOISE_FIELDS))


def _wave_vectors(in_space: bool) -> FloatArray:
    """Of :data:`_WAVES` waves, (W, 2 or 3), in all directions; wavelengths are spread evenly in their logarithm."""
    number = np.arange(_WAVES)
    length = _SHORTEST * (_LONGEST / _SHORTEST) ** ((number + 0.5) / _WAVES)
    # Directions by an additive recurrence, which is even at all lengths (Roberts 2018).
    turn = 2.0 * math.pi * (0.7548776662466927 * number % 1.0)
    rise = 2.0 * (0.5698402909980532 * number % 1.0) - 1.0 if in_space else np.zeros(_WAVES)
    flat = np.sqrt(1.0 - rise**2)
    vectors = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), rise]) * (2.0 * math.pi / length)[:, None]
    return vectors if in_space else vectors[:, :2]
