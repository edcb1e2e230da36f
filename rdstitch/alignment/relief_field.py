"""What relief does to a lens: hills are laid under the images, and the adjustment answers them.

Relief moves all points of a place together, in every image that shows it, and a part of that the parameters absorb:
hills as wide as an overlap are fitted by its homography and by λ. What is left over shows how steep the hills are, and
by how much they can have moved λ: errors agree from one neighbour to the next. The answers to waves of all widths give
both, the agreement that they leave, and how far they move λ. All widths are taken to be equally steep, as most ground
roughly is (a power law; Mandelbrot 1975).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rdstitch.alignment.least_squares.linear_response import Fields, LinearResponse
from rdstitch.alignment.least_squares.link_equations import LinearizedErrors
from rdstitch.alignment.noise import neighbours
from rdstitch.alignment.parallax import Parallax
from rdstitch.arrays import FloatArray, IntArray

_SHORTEST = 0.5  # half diagonals of an image on the ground: the shortest wavelength that neighbours show
_LONGEST = 6.0  # the same: a wavelength that poses absorb whole
_WAVES = 32  # waves, each as a sine and a cosine
_BANDS = 4  # of waves that are answered together

_NOISE_FIELDS = 16
"""Fields of independent errors that show what their absorption leaves of agreement between neighbours."""

_CURVATURES = 3  # of a plane: along x, aslant, and along y

_UNSEEN = 1e-9  # information, over the largest, that is none
_NEWTON_STEPS = 50  # steps to the variance of curvatures at most


@dataclass(frozen=True)
class ReliefField:
    """Ground under the images of an adjustment."""

    response: LinearResponse

    def steps(self) -> tuple[FloatArray, FloatArray]:
        """Steps of the poses (N, D, K) and the shared parameters (S, K) by relief; ``x x'`` is its covariance."""
        normal = self.response.normal
        steps = [(np.zeros((*normal.gradient_poses.shape, 0)), np.zeros((len(normal.gradient_shared), 0)))]
        if (agreement := self._agreement()) > 0.0:
            steps.append(self._steps_by_waves(agreement))
        if not self._parallax.is_turn and len(self.response.adjuster.observations) > 1:
            steps.append(self._steps_by_curvature())
        poses, shared = zip(*steps, strict=True)
        return np.concatenate(poses, axis=-1), np.concatenate(shared, axis=-1)

    def _steps_by_waves(self, agreement: float) -> tuple[FloatArray, FloatArray]:
        """Steps by relief as steep as leaves the agreement of errors that was found, px²."""
        step = _WAVES // _BANDS
        responses = [self._response_to(self._waves(start, step), 2 * step) for start in range(0, _WAVES, step)]
        left = float(np.mean([left for left, *_ in responses]))
        scale = math.sqrt(agreement / left / (2 * _WAVES)) if left > 0.0 else 0.0
        poses, shared = (np.concatenate([response[k] for response in responses], axis=-1) for k in (1, 2))
        return poses * scale, shared * scale

    def _steps_by_curvature(self) -> tuple[FloatArray, FloatArray]:
        """Steps by a plane that is curved alike everywhere, as a wall may be: what pairs absorb of it does not cancel.

        How much curvature there is shows what they do not absorb of it, beyond noise; of one pair next to nothing.
        """
        poses, shared = self.response.steps_of(self._curved, _CURVATURES)
        information, score = np.zeros((_CURVATURES, _CURVATURES)), np.zeros(_CURVATURES)
        for part in self.response.parts():
            left = self._curved(part) + self.response.changes(part, poses, shared)
            weight = self.response.weight[part.rows]
            information += self.response.curvature * np.einsum("m,mic,mid->cd", weight, left, left)
            score += np.einsum("m,mic,mi->c", weight, left, part.errors)
        std = math.sqrt(_variance_between(information, score))
        return poses * std, shared * std

    def _curved(self, part: LinearizedErrors) -> FloatArray:
        """Errors (m, 2, C) by curvature along x, aslant, and along y."""
        place, parallax = self._parallax.of(part)
        x, y = self._parallax.from_middle(place).T
        heights = np.column_stack([x * x, math.sqrt(2.0) * x * y, y * y])
        return np.asarray(parallax[:, :, None] * heights[:, None, :])

    def _agreement(self) -> float:
        """Mean product of the errors of neighbours, px², beyond what the absorption of independent errors leaves: less
        than none, since the parameters absorb what they have in common. 0 where there is none.
        """
        first, second = self._pairs
        if not len(first):
            return 0.0
        o, errors = self.response.adjuster.observations, self._errors
        products = np.einsum("mi,mi->m", errors[first], errors[second])
        off, power = products - products.mean(), float((errors[np.unique(self._pairs)] ** 2).mean())
        excess = float(products.mean()) - power * self._response_to(_independent, _NOISE_FIELDS)[0]
        # Errors of a link depend on each other; of one link alone that does not show.
        variance = max((np.bincount(o.link[first], off, len(o)) ** 2).sum(), (off**2).sum()) / len(first) ** 2
        # Less what chance makes of it: the positive part of James and Stein's estimate.
        return max(excess - float(variance) / excess, 0.0) if excess > 0.0 else 0.0

    @cached_property
    def _errors(self) -> FloatArray:
        """Errors (M, 2), pixels, that are left when all follows them that may be free, a lens that was held included.

        As waves are answered: what that lens explains is no relief.
        """
        step = self.response.step()
        return np.concatenate(
            [part.errors + self.response.changes(part, *step)[..., 0] for part in self.response.parts()]
        )

    def _response_to(self, fields: Fields, columns: int) -> tuple[float, FloatArray, FloatArray]:
        """Agreement of neighbours, px², that fields leave in the mean, and the steps (N, D, C) and (S, C) in answer."""
        poses, shared = self.response.steps_of(fields, columns)
        (first, second), agreement = self._pairs, 0.0
        for part in self.response.parts():
            left = fields(part) + self.response.changes(part, poses, shared)
            chosen = slice(*np.searchsorted(first, [part.rows.start, part.rows.stop]).tolist())
            a, b = (left[rows[chosen] - part.rows.start] for rows in (first, second))
            agreement += float(np.einsum("mic,mic->", a, b)) / (len(first) * columns)
        return agreement, poses, shared

    def _waves(self, start: int, count: int) -> Fields:
        """Sines and cosines of some of the waves, from the ``start``-th."""
        size = self._parallax.size
        waves = _wave_vectors(self._parallax.is_turn)[start : start + count] / size
        # Equally steep, waves are the higher the longer they are.
        height = 1.0 / np.linalg.norm(waves * size, axis=1)

        def fields(part: LinearizedErrors) -> FloatArray:
            place, parallax = self._parallax.of(part)
            phase = place @ waves.T
            heights = np.concatenate([height * np.cos(phase), height * np.sin(phase)], axis=1)
            return np.asarray(parallax[:, :, None] * heights[:, None, :])

        return fields

    @cached_property
    def _parallax(self) -> Parallax:
        return Parallax(self.response.adjuster, self.response.result)

    @cached_property
    def _pairs(self) -> IntArray:
        """Inliers and neighbours of theirs in the same link, (2, P), by the first of each pair."""
        pairs = neighbours(self.response.adjuster.observations, self.response.result.inliers)
        return np.unique(np.sort(np.stack(pairs), axis=0), axis=1)


def _variance_between(information: FloatArray, score: FloatArray) -> float:
    """Variance of parameters about 0, by the information (P, P) of noisy estimates of them and their score (P,).

    That with which the squares of the estimates over their variances add up to their number (Paule and Mandel 1982),
    less what chance makes of it: the positive part of James and Stein's estimate.
    """
    values, vectors = np.linalg.eigh(information)
    seen = values > _UNSEEN * values[-1]
    precision, squared = values[seen], (vectors.T @ score)[seen] ** 2 / values[seen]
    excess = float(squared.sum()) - len(squared)
    expected, variance = len(squared) * (1.0 + 2.0 / max(excess, 1e-300)), 0.0
    for _ in range(_NEWTON_STEPS):  # from below to the root of a convex function
        grown = 1.0 + variance * precision
        excess = float((squared / grown).sum()) - expected
        if excess <= 0.0:
            break
        variance += excess / float((squared * precision / grown**2).sum())
    return variance


def _independent(part: LinearizedErrors) -> FloatArray:
    """Independent errors of standard deviation 1, always the same ones."""
    return np.random.default_rng(part.first).normal(size=(*part.errors.shape, _NOISE_FIELDS))


def _wave_vectors(in_space: bool) -> FloatArray:
    """Vectors of :data:`_WAVES` waves (W, 2 or 3) in all directions; wavelengths are even in their logarithm."""
    number = np.arange(_WAVES)
    length = _SHORTEST * (_LONGEST / _SHORTEST) ** ((number + 0.5) / _WAVES)
    # Directions by an additive recurrence, which is even at all lengths (Roberts 2018).
    turn = 2.0 * math.pi * (0.7548776662466927 * number % 1.0)
    rise = 2.0 * (0.5698402909980532 * number % 1.0) - 1.0 if in_space else np.zeros(_WAVES)
    flat = np.sqrt(1.0 - rise**2)
    vectors = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), rise]) * (2.0 * math.pi / length)[:, None]
    return vectors if in_space else vectors[:, :2]
