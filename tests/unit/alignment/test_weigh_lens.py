"""λ is as far from what lenses usually have as the images make sure, errors that neighbours share considered."""

import importlib
from dataclasses import replace

import numpy as np
import pytest

from examples.worlds.alignment_scenes import Scene, aligned, grid, scene
from examples.worlds.lens_scenes import SIZE
from rdstitch.alignment import Alignment
from rdstitch.geometry.camera import Camera


def pair(seed: int, *, distortion: float = 0.0, noise: float = 0.5, count: int = 80, depth: float = 0.0) -> Scene:
    """Two images; ``depth`` moves the matches of the second by so many pixels, together where they are neighbours."""
    rng = np.random.default_rng(seed)
    poses = grid(2, 1, (0.3, 0.3), 0.3, rng)
    lens = Camera(SIZE, distortion)
    given = scene(poses, lens=lens, rng=rng, noise=noise, focal=420.0, per_link=count, outliers=0.0)
    (link,) = given.links
    places = lens.normalize(link.points1)
    moved = np.column_stack([np.sin(4.0 * places[:, 1]), 3.0 * (places**2).sum(axis=1) * places[:, 1]])
    return replace(given, links=[replace(link, points2=link.points2 + depth * moved)])


def unweighed(given: Scene, monkeypatch: pytest.MonkeyPatch) -> Alignment:
    with monkeypatch.context() as without:
        without.setattr(importlib.import_module("rdstitch.alignment.align"), "weigh_lens", lambda problem, fit, _: fit)
        return aligned(given)


@pytest.mark.parametrize("seed", [0, 4])
def test_depth_makes_no_lens_of_two_images(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    given = pair(seed, depth=3.0)
    before, after = unweighed(given, monkeypatch), aligned(given)
    assert before.distortion_std > 0.02
    assert 0.0 < after.distortion < 0.9 * before.distortion
    assert after.distortion_std > 0.02


def test_a_lens_that_two_images_show_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    given = pair(1, distortion=-0.25, noise=0.2, count=500)
    found = aligned(given)
    assert found.distortion == unweighed(given, monkeypatch).distortion == pytest.approx(-0.25, abs=0.003)
