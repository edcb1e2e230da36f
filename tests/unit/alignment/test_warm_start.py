"""An alignment that starts at an earlier one: the same result for less, and none of the earlier one's mistakes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rdstitch.alignment import AlignmentOptions, align
from rdstitch.alignment.adjustment_problem import Problem
from rdstitch.alignment.result import Alignment, PlanarPoses
from tests.alignment_scenes import Scene, grid, jittered, scene
from tests.sampled import sampled


def _drone(height: float, tilt: float) -> Scene:
    rng = np.random.default_rng(2)
    poses = jittered(grid(4, 3, (0.4, 0.3), 0.25, rng), height, math.radians(tilt), rng)
    return scene(poses, tilt=(0.04, -0.03), focal_source="exif", rng=rng, per_link=120)


@pytest.fixture
def links_apart(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Models over a plane that started at chained links."""
    called: list[str] = []
    original = Problem._links_apart

    def counted(self: Problem, model, others, start):  # type: ignore[no-untyped-def]
        called.append(model.name)
        return original(self, model, others, start)

    monkeypatch.setattr(Problem, "_links_apart", counted)
    return called


def _same(found: Alignment, cold: Alignment) -> bool:
    return bool(
        found.distortion == cold.distortion and np.array_equal(found.homographies, cold.homographies, equal_nan=True)
    )


@pytest.mark.parametrize(
    ("height", "tilt", "model"), sampled([(0.2, 3.0, "tilting"), (0.0, 0.0, "rigid"), (0.2, 0.0, "similarity")])
)
def test_more_links_give_what_they_give_without_the_earlier_alignment(
    links_apart: list[str], height: float, tilt: float, model: str
) -> None:
    given = _drone(height, tilt)
    former = align(given.cameras, [link for k, link in enumerate(given.links) if k % 5])
    cold = align(given.cameras, given.links)
    assert {"rigid", "similarity"} & set(links_apart)
    links_apart.clear()
    warm = align(given.cameras, given.links, former=former)
    assert "rigid" not in links_apart
    assert "similarity" not in links_apart
    assert warm.model == cold.model == model
    assert warm.lens == cold.lens
    assert abs(warm.distortion - cold.distortion) < 0.1 * cold.distortion_std
    assert warm.rms == pytest.approx(cold.rms, rel=1e-3)
    corners = np.array([(0.0, 0.0), (639.0, 0.0), (639.0, 479.0), (0.0, 479.0)])
    for link in given.links:
        there = [found.transfer(link.image1, link.image2, corners) for found in (warm, cold)]
        assert np.abs(there[0] - there[1]).max() < 0.02


def _misplaced(former: Alignment) -> Alignment:
    """One image lies a tenth of the height elsewhere."""
    position = former.poses.position.copy()
    position[5] += 0.1
    poses = PlanarPoses(former.poses.yaw, position, former.poses.height, former.poses.tilt)
    return replace(former, poses=poses)


def _without_one(former: Alignment) -> Alignment:
    return replace(former, used=former.used & (np.arange(len(former.used)) != 5))


def _of_another_lens(former: Alignment) -> Alignment:
    return replace(former, cameras=tuple(replace(camera, distortion=-0.1) for camera in former.cameras))


def _of_another_focal_length(former: Alignment) -> Alignment:
    return replace(former, focal=1.3 * former.focal)


@pytest.mark.parametrize("spoil", sampled([_misplaced, _of_another_lens, _without_one, _of_another_focal_length], 1))
def test_an_earlier_alignment_that_the_links_contradict_changes_nothing(spoil) -> None:  # type: ignore[no-untyped-def]
    given = _drone(0.2, 3.0)
    cold = align(given.cameras, given.links)
    assert not _same(align(given.cameras, given.links, former=cold), cold)
    assert _same(align(given.cameras, given.links, former=spoil(cold)), cold)


def test_pairs_that_ask_for_a_richer_lens_start_at_the_simpler_one(links_apart: list[str]) -> None:
    given = _drone(0.2, 3.0)
    former = align(given.cameras, given.links, AlignmentOptions(lens="division"))
    links_apart.clear()
    found = align(given.cameras, given.links, AlignmentOptions(lens="division2"), former=former)
    assert not {"rigid", "similarity", "rotation"} & set(links_apart)
    assert (former.lens, found.lens) == ("division", "division2")


def test_a_lens_that_was_given_stays() -> None:
    given = _drone(0.2, 0.0)
    former = align(given.cameras, given.links)
    cameras = [replace(camera, distortion=-0.249) for camera in given.cameras]
    found = align(cameras, given.links, AlignmentOptions(lens_known=True), former=former)
    assert found.distortion == -0.249
