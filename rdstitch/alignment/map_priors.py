"""Positions of cameras and ground control points as priors: what bends a long chain hardly changes how neighbours fit.

The plane is a view from above, so that a similarity takes metres east and south to it. It is fitted robustly, the
cameras and the points are drawn to where it puts them, each as surely as its accuracy and the scatter that is left
say, and so in turn; the frame is free meanwhile. Where the images disagree, with larger errors or with cameras that
stay away, the map does not count.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjuster
from rdstitch.alignment.least_squares.plane_marks import ControlPoints, PlaneMarks
from rdstitch.alignment.least_squares.priors import CameraPriors
from rdstitch.alignment.motion_models import X, Y
from rdstitch.alignment.sentences import map_contradicted
from rdstitch.arrays import ComplexArray, FloatArray, IntArray, evenly_spaced
from rdstitch.geometry.places import MILLIMETRE, POSITION_STD
from rdstitch.numerics.robust_loss import RAYLEIGH_MEDIAN
from rdstitch.results.messages import Message
from rdstitch.robust.posterior import MODEL_ERROR
from rdstitch.robust.similarity_fit import OUTLYING, SimilarityFit, fit_similarity

_MIN_POSITIONS = 4  # positions that say anything of the shape
_MIN_CONTROL = 3  # control points that do
_MIN_SPREAD = 5.0  # standard deviations of one that they must be spread over
_CLICK = 0.5  # pixels: of a coordinate of where an image shows a control point
_ROUNDS = 8  # rounds of fitting the similarity and adjusting again
_SETTLED = 0.1  # standard deviations by which what is known still moves at the end
_MAX_GROWTH = 1.1  # times by which the errors of the images may grow
_SURE = 1.0 - 1e-6  # leverage beyond which rounding counts
_MANY = 50  # positions whose leverage is computed; that of others is taken to be the median

_COMPLEX = np.array([1.0, 1.0j])


@dataclass(frozen=True)
class MapFit:
    """A fit with what the map says, or without, and why."""

    problem: Problem
    fit: Fit
    disagreement: Message | None = None
    leverage: Mapping[int | str, float] = field(default_factory=dict)  # by image of the problem, and name of a point


def adjust_to_map(problem: Problem, fit: Fit) -> MapFit:
    """Adjust again with positions and control points as priors, where there are enough of them, and they agree."""
    if not fit.model.has_metric_poses:
        return MapFit(problem, fit)
    kinds: list[_KnownPlaces] = [_Control(problem, fit), _Positions(problem)]
    known = [places for places in kinds if places.enough]
    disagreement = None
    while known:
        with_map = _adjusted(problem, fit, known)
        if with_map.disagreement is None:
            return replace(with_map, disagreement=disagreement)
        disagreement, known = disagreement or with_map.disagreement, known[1:]
    return MapFit(problem, fit, disagreement)


class _KnownPlaces(ABC):
    """N places that are known on the map, and where a fit has them, in units of the poses."""

    metres: ComplexArray  # (N,): east - i north
    std: FloatArray  # (N,): of a coordinate, m
    labels: Sequence[int | str]  # (N,): images, or names
    item: IntArray  # (M,): which of the places each row of the derivatives is of
    min_count: int
    name: str

    @abstractmethod
    def estimated(self, fit: Fit) -> ComplexArray:
        """Where a fit has them, (N,)."""

    @abstractmethod
    def prior(self, priors: CameraPriors, target: FloatArray, precision: FloatArray) -> CameraPriors:
        """Priors with those on the places: their means (N, 2) and inverse variances (N,)."""

    @abstractmethod
    def jacobians(self, adjuster: BundleAdjuster, fit: Fit) -> tuple[IntArray, FloatArray, FloatArray]:
        """Images (M,), derivatives (M, 2, D + S + K) of places by their poses and the shared parameters, precision."""

    @property
    def enough(self) -> bool:
        """Whether they say anything of the shape; whatever a few of them are."""
        if len(self.metres) < self.min_count:
            return False
        middle = complex(np.median(self.metres.real), np.median(self.metres.imag))
        return float(np.median(np.abs(self.metres - middle) / self.std)) >= _MIN_SPREAD

    def prior_from_map(self, priors: CameraPriors, fit: Fit) -> tuple[CameraPriors, SimilarityFit, float]:
        """The prior by the places of a fit, the similarity to the map, and by how much errors exceed their std."""
        places = self.estimated(fit)
        similar = fit_similarity(places, self.metres, float(np.median(self.std)))
        scale = similar.scale or 1e-300
        target = ((self.metres - similar.origin) / scale).view(np.float64).reshape(-1, 2)
        count = len(places)
        excess = float(np.median(similar.residuals / self.std)) / RAYLEIGH_MEDIAN * math.sqrt(count / (count - 2))
        excess = max(excess, 1.0)
        precision = similar.weights * (abs(scale) / (self.std * excess)) ** 2
        return self.prior(priors, target, precision), similar, excess


class _Positions(_KnownPlaces):
    min_count, name = _MIN_POSITIONS, "GPS positions"

    def __init__(self, problem: Problem) -> None:
        metres, std = problem.camera_priors.positions @ np.array([1.0, -1.0j]), problem.camera_priors.positions_std
        self.known = np.isfinite(metres)
        self.metres = metres[self.known]
        self.std = np.where(np.isfinite(std), std, POSITION_STD)[self.known]
        self.labels, self.item = np.flatnonzero(self.known).tolist(), np.arange(len(self.metres))

    def estimated(self, fit: Fit) -> ComplexArray:
        return np.asarray(fit.result.parameters.poses[self.known][:, [X, Y]] @ _COMPLEX)

    def prior(self, priors: CameraPriors, target: FloatArray, precision: FloatArray) -> CameraPriors:
        places, weights = np.zeros((len(self.known), 2)), np.zeros(len(self.known))
        places[self.known], weights[self.known] = target, precision
        return replace(priors, places=places, places_precision=weights)

    def jacobians(self, adjuster: BundleAdjuster, fit: Fit) -> tuple[IntArray, FloatArray, FloatArray]:
        image = np.flatnonzero(self.known)
        axes = [fit.model.free.index(column) for column in (X, Y)]
        shared = len(fit.model.shared_names) + int(adjuster.free.lens.sum())
        derivative = np.zeros((len(image), 2, fit.model.pose_size + shared))
        derivative[:, [0, 1], axes] = 1.0
        return image, derivative, adjuster.priors.poses_precision[image, axes[0]]


class _Control(_KnownPlaces):
    min_count, name = _MIN_CONTROL, "ground control points"

    def __init__(self, problem: Problem, fit: Fit) -> None:
        given = problem.camera_priors.control
        self.points = control = given.take(np.asarray(np.isfinite(_sightings(given, fit)).all(axis=1)))
        self.labels = list(dict.fromkeys(control.name.tolist()))
        self.item = np.array([self.labels.index(name) for name in control.name.tolist()], dtype=np.intp)
        self.count = np.bincount(self.item, minlength=len(self.labels))
        first = np.unique(self.item, return_index=True)[1]
        self.metres, self.std = (
            control.place[first] @ np.array([1.0, -1.0j]),
            np.maximum(control.std[first], MILLIMETRE),
        )
        if len(self.metres) >= self.min_count:
            places = self.estimated(fit)
            pixel = np.bincount(self.item, control.pixel) / self.count
            scale = abs(fit_similarity(places, self.metres, float(np.median(self.std))).scale)
            self.std = np.hypot(self.std, _CLICK * pixel * scale)

    def estimated(self, fit: Fit) -> ComplexArray:
        sums = np.zeros((len(self.metres), 2))
        np.add.at(sums, self.item, _sightings(self.points, fit))
        return np.asarray((sums / self.count[:, None]) @ _COMPLEX)

    def prior(self, priors: CameraPriors, target: FloatArray, precision: FloatArray) -> CameraPriors:
        shown = self.points
        # What a point is off by is the same in all images that show it.
        shared = (precision / self.count)[self.item]
        return replace(priors, marks=PlaneMarks(shown.image, shown.points, target[self.item], shared))

    def jacobians(self, adjuster: BundleAdjuster, fit: Fit) -> tuple[IntArray, FloatArray, FloatArray]:
        parameters, marks = fit.result.parameters, adjuster.priors.marks
        assert marks is not None
        focal = fit.model.focal(parameters.shared)
        derivative = marks.equations(fit.result.matrices, parameters.lens, adjuster.free.lens, focal)[1]
        return marks.image, derivative, marks.precision


def _sightings(control: ControlPoints, fit: Fit) -> FloatArray:
    """Where a fit has each sighting of control points, (M, 2); not finite where no place looks like that."""
    adjusted = fit.result
    marks = PlaneMarks(control.image, control.points, control.points, np.zeros(len(control)))
    focal = fit.model.focal(adjusted.parameters.shared)
    return marks.places(adjusted.matrices.matrices, adjusted.parameters.lens, focal)


def _adjusted(problem: Problem, fit: Fit, known: list[_KnownPlaces]) -> MapFit:
    """The fit with all known places; without them and why, where the images contradict the first kind of them."""
    refined, free_frame = fit, replace(problem.camera_priors, fix_frame=False)
    for _ in range(_ROUNDS):
        before, priors = [places.estimated(refined) for places in known], free_frame
        on_map: list[tuple[SimilarityFit, float]] = []
        for places in known:
            priors, similarity, excess = places.prior_from_map(priors, refined)
            on_map.append((similarity, excess))
        with_map = replace(problem, camera_priors=priors)
        refined = with_map.refine(fit.model, refined.result.parameters, fit.tilt_spread)
        moved = [
            np.abs(places.estimated(refined) - former).max() * abs(similarity.scale) / (np.median(places.std) * excess)
            for places, former, (similarity, excess) in zip(known, before, on_map, strict=True)
        ]
        if max(moved) < _SETTLED:
            break
    growth = math.hypot(refined.result.sigma, MODEL_ERROR) / math.hypot(fit.result.sigma, MODEL_ERROR)
    distance = float(np.median(on_map[0][0].residuals))
    far = isinstance(known[0], _Positions) and distance > OUTLYING * max(float(np.median(known[0].std)), POSITION_STD)
    if far or growth > _MAX_GROWTH:
        return MapFit(problem, fit, map_contradicted(known[0].name, distance if far else None, growth))
    fixed = replace(with_map, camera_priors=replace(with_map.camera_priors, fix_frame=True))
    return MapFit(fixed, refined, None, _leverage(with_map, refined, known))


def _leverage(problem: Problem, fit: Fit, known: Sequence[_KnownPlaces]) -> dict[int | str, float]:
    """How far (0 to 1) what is known puts itself where the fit has it; by the label of each."""
    adjuster = problem.adjuster_of(fit)
    normal, (count, size) = adjuster.normal_equations(fit.result), adjuster.free.poses.shape
    leverage: dict[int | str, float] = {}
    for places in known:
        image, derivative, precision = places.jacobians(adjuster, fit)
        item, names = places.item, places.labels
        chosen = evenly_spaced(len(names), _MANY)
        gradients = np.zeros((count, size, len(chosen), 2))
        of_shared = np.zeros((len(normal.gradient_shared), len(chosen), 2))
        counts, sums = np.bincount(item, minlength=len(names)), np.bincount(item, precision, len(names))
        for column, one in enumerate(chosen.tolist()):
            for m in np.flatnonzero(item == one).tolist():
                gradients[image[m], :, column] += derivative[m, :, :size].T / counts[one]
                of_shared[:, column] += derivative[m, :, size:].T / counts[one]
        flat = gradients.reshape(count, size, -1), of_shared.reshape(len(of_shared), -1)
        steps = normal.responses(-flat[0], -flat[1])
        variance = (flat[0] * steps[0]).sum(axis=(0, 1)) + (flat[1] * steps[1]).sum(axis=0)
        of_chosen = np.clip(np.reshape(variance, (-1, 2)).mean(axis=1) * sums[chosen], 0.0, _SURE)
        of_all = np.full(len(names), np.median(of_chosen))
        of_all[chosen] = of_chosen
        leverage.update(zip(names, np.where(sums > 0.0, of_all, 0.0).tolist(), strict=True))
    return leverage
