"""The third coefficient of a lens: where all images together may show it, and nowhere else."""

import importlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from examples.worlds.alignment_scenes import aligned
from examples.worlds.lens_scenes import FISHEYE, SIZE, lens_distance, lens_scene
from rdstitch.alignment import lens_selection
from rdstitch.alignment.lens_selection import LensChoice
from rdstitch.alignment.observations import Observations
from rdstitch.geometry.camera import Camera

align_module = importlib.import_module("rdstitch.alignment.align")


def test_all_images_together_show_a_third_coefficient_that_pairs_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    given = lens_scene(replace(FISHEYE, distortion2=-0.03, distortion3=-0.03), 0)
    chosen = []

    def choose(seen: Observations, apart: Any, names: object, known: Any) -> LensChoice:
        chosen.append(lens_selection.choose_lens(seen, apart, ["division", "division2"], known))
        return chosen[-1]

    monkeypatch.setattr(align_module, "choose_lens", choose)
    found, simpler = aligned(given), aligned(given, lens="division2")
    assert chosen[0].name == "division2"
    assert found.lens == "division3"
    assert "distortion3" in found.parameters
    truth = replace(FISHEYE, distortion2=-0.03, distortion3=-0.03)
    assert lens_distance(found.cameras[0], truth) < lens_distance(simpler.cameras[0], truth)


@pytest.mark.slow
def test_a_third_coefficient_that_is_smaller_than_its_deviation_does_no_harm() -> None:
    truth = replace(FISHEYE, distortion3=0.0)
    given = lens_scene(truth, 0)
    found, simpler = aligned(given), aligned(given, lens="division2")
    assert found.lens == "division3"
    assert abs(found.cameras[0].distortion3) < 2.0 * np.sqrt(np.array(found.cameras[0].lens_covariance)[2, 2]) < 0.01
    assert lens_distance(found.cameras[0], truth) < lens_distance(simpler.cameras[0], truth) + 0.03


def test_a_third_coefficient_is_small_where_no_matches_show_it() -> None:
    """An equidistant fisheye of 120 degrees; matches in the middle alone leave ν to its prior."""
    truth = Camera(SIZE, -0.366, -0.026, (335.0, 226.0), distortion3=-0.0036)
    given = lens_scene(truth, 3)
    links = []
    for link in given.links:
        near = [np.linalg.norm(truth.normalize(points), axis=1) < 0.6 for points in (link.points1, link.points2)]
        kept = near[0] & near[1]
        links.append(replace(link, points1=link.points1[kept], points2=link.points2[kept]))
    found = aligned(replace(given, links=[link for link in links if len(link) >= 30]), lens="division3")
    assert lens_distance(found.cameras[0], truth) < 1.0


@pytest.mark.slow
def test_a_third_coefficient_is_not_taken_from_relief() -> None:
    given = lens_scene(replace(FISHEYE, distortion3=0.0), 0, relief=0.01)
    assert aligned(given).lens == "division2"
