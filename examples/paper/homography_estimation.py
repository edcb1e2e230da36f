"""Homography estimation under distortion: accuracy of robust estimators on the same matches."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from examples.paper.common.estimation_pairs import JudgedPair, made_scenes, read_scenes, rendered_pairs, scene_pairs
from examples.paper.common.estimators import THRESHOLD, Estimator, Judgement, installed_estimators, judge
from examples.paper.common.report import Report, Settings, Table
from rdstitch.io.read import read_image

LIMITS = (1.0, 3.0, 5.0)
"""Of the areas under the curve, px."""

DISTORTION = -0.4
"""λ is uniform from this to 0."""

_IMAGES_PER_SCENE = 5


def run(settings: Settings) -> Report:
    """Areas under the curves of accuracy, errors of λ and processor time."""
    estimators, notes = installed_estimators()
    judged = {name: _judge_all(estimators, pairs) for name, pairs in _families(settings).items()}
    tables = tuple(_table(name, results) for name, results in judged.items())
    if settings.hpatches is None:
        notes += ("HPatches was not given (--hpatches) and was left out",)

    def draw(figure: Any) -> None:
        for axes, (name, results) in zip(
            figure.subplots(1, len(judged), squeeze=False)[0], judged.items(), strict=True
        ):
            for estimator, found in results.items():
                errors = np.sort([judgement.error for judgement in found])
                share = np.arange(1, len(errors) + 1) / len(errors)
                axes.step(np.clip(errors, 1e-2, 1e2), share, where="post", label=estimator)
            axes.set_xscale("log")
            axes.set_xlabel("mean error, px")
            axes.set_ylabel("share of pairs")
            axes.set_title(name, fontsize=8)
            axes.set_xlim(1e-2, 1e2)
            axes.legend(fontsize=6, loc="upper center", bbox_to_anchor=(0.5, -0.18))

    return Report(tables, draw, notes=notes)


def area_under_curve(errors: ArrayLike, limit: float) -> float:
    """Area under the curve of the share of errors below a value, from 0 to ``limit``, in units of the limit."""
    values = np.asarray(errors, dtype=np.float64)
    return float(np.mean(np.clip(1.0 - values / limit, 0.0, 1.0)))


def _families(settings: Settings) -> dict[str, Iterable[JudgedPair]]:
    count = settings.count(2, 16, 100)
    families: dict[str, Iterable[JudgedPair]] = {
        "rendered, planar motion": rendered_pairs(count, DISTORTION, free=False, seed=600),
        "rendered, free motion": rendered_pairs(count, DISTORTION, free=True, seed=900),
        "rendered, free motion, no distortion": rendered_pairs(count, 0.0, free=True, seed=900),
    }
    photos = settings.real_sequence("textures_cc0")
    photo = np.asarray(read_image(photos[0]).pixels) if photos else None
    what = "rendered ground" if photo is None else "an aerial photo"
    scenes = made_scenes(photo, count, seed=1200)
    families[f"as in HPatches, of {what}"] = scene_pairs(scenes, DISTORTION, seed=1500, per_scene=1)
    if settings.hpatches is not None:
        real = read_scenes(settings.hpatches)[: settings.count(1, 8, 1000)]
        families["HPatches"] = scene_pairs(real, DISTORTION, seed=1800, per_scene=_IMAGES_PER_SCENE)
    return families


def _judge_all(estimators: list[Estimator], pairs: Iterable[JudgedPair]) -> dict[str, list[Judgement]]:
    results: dict[str, list[Judgement]] = {estimator.name: [] for estimator in estimators}
    for pair in pairs:
        for estimator in estimators:
            results[estimator.name].append(judge(estimator, pair))
    return results


def _table(name: str, results: dict[str, list[Judgement]]) -> Table:
    unit = float(np.median([judgement.seconds for judgement in next(iter(results.values()))]))
    rows = []
    for estimator, found in results.items():
        errors = [judgement.error for judgement in found]
        areas = (100.0 * area_under_curve(errors, limit) for limit in LIMITS)
        lam = None if "no λ" in estimator else float(np.median([judgement.distortion_error for judgement in found]))
        duration = float(np.median([judgement.seconds for judgement in found]))
        rows.append((estimator, *areas, float(np.median(errors)), lam, duration / unit))
    curves = (f"AUC at {limit:g} px, %" for limit in LIMITS)
    header = ("estimator", *curves, "median error, px", "median error of λ", "processor time, rdstitch's = 1")
    count = len(next(iter(results.values())))
    title = f"Homography estimation: {name}, {count} pairs, threshold {THRESHOLD:g} px, error in px of image 2"
    return Table(title, header, tuple(rows))
