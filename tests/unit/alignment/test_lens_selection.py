"""The ladder of lenses: as simple as the images allow, never taken in by relief, near what lenses usually have."""

import importlib
import math
import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from examples.worlds.alignment_scenes import Scene, aligned, grid_scene
from examples.worlds.lens_scenes import FISHEYE, SIZE, lens_distance, lens_scene
from rdstitch.alignment import LENSES, Alignment, AlignmentOptions
from rdstitch.alignment.adjustment_problem import LinkProblem
from rdstitch.alignment.lens import lens_selection
from rdstitch.alignment.lens.lens_description import describe_lens, radius_std
from rdstitch.alignment.lens.lens_selection import LensChoice, free_parameters
from rdstitch.alignment.pairwise import pairwise_homographies
from rdstitch.geometry.camera import LENS_PARAMETERS, Camera
from tests.alignment_stubs import adjusted, independent_errors, observations
from tests.sampled import sampled

OFF_CENTRE = Camera(SIZE, -0.25, 0.0, (339.0, 229.0))


@pytest.mark.parametrize("seed", sampled(range(3)))
def test_one_parameter_stays_one_parameter(seed: int) -> None:
    found = aligned(lens_scene(Camera(SIZE, -0.25), seed))
    assert found.lens == "division"
    assert found.cameras[0].coefficients[1:] == (0.0, 0.0)
    assert found.cameras[0].center == (319.5, 239.5)
    assert abs(found.distortion + 0.25) < 4.0 * found.distortion_std < 0.002


@cache
def fisheye_alignment() -> tuple[Scene, Alignment]:
    """The scene of a fisheye off centre, and what is found of it."""
    given = lens_scene(FISHEYE, 0)
    return given, aligned(given)


def described(alignment: Alignment) -> tuple[str, ...]:
    return describe_lens(alignment, alignment.cameras[alignment.reference])


def test_a_fisheye_off_centre_is_found() -> None:
    given, found = fisheye_alignment()
    plain = aligned(given, lens="division")
    assert found.lens in ("division2", "division3")
    assert lens_distance(found.cameras[0], FISHEYE) < 0.3 < 1.5 < lens_distance(plain.cameras[0], FISHEYE)
    assert found.distortion == found.cameras[0].nearest_distortion
    assert abs(found.distortion - FISHEYE.nearest_distortion) < 0.003
    covariance = np.array(found.cameras[0].lens_covariance)
    assert covariance.shape == (len(LENS_PARAMETERS),) * 2
    offset = np.array(found.cameras[0].center) - FISHEYE.center
    assert (np.abs(offset) < 5.0 * np.sqrt(np.diag(covariance))[3:] * found.cameras[0].scale + 0.1).all()
    assert found.lens_reason.startswith("division3: ")


def test_some_of_very_many_links_show_the_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    given, every = fisheye_alignment()
    sizes = []

    def noted(links: LinkProblem) -> Any:
        sizes.append(len(links.observations))
        return pairwise_homographies(links)

    monkeypatch.setattr(lens_selection, "pairwise_homographies", noted)
    monkeypatch.setattr(lens_selection, "_ENOUGH_LINKS", len(given.links) // 2)
    found = aligned(given)
    assert found.lens == every.lens
    assert lens_distance(found.cameras[0], every.cameras[0]) < 0.1
    assert len(found.links) == len(given.links)
    assert sorted(sizes)[-2] <= len(given.links) // 2  # all of them once at most


def test_a_centre_off_the_middle_is_found_alone() -> None:
    found = aligned(lens_scene(OFF_CENTRE, 1))
    assert found.lens == "division-center"
    np.testing.assert_allclose(found.cameras[0].center, OFF_CENTRE.center, atol=1.5)
    assert found.cameras[0].higher == ()


def test_a_pair_says_whether_it_shows_the_lens() -> None:
    messages = []
    for noise, per_link in ((0.05, 2000), (1.0, 60)):
        lens = Camera(SIZE, -0.25)
        given = grid_scene(
            2, 1, (0.5, 0.35), 0.5, seed=0, lens=lens, noise=noise, focal=420.0, per_link=per_link, outliers=0.0
        )
        found = aligned(given)
        assert found.lens == "division"
        messages.append([message for message in found.messages if message.code == "few-images"])
    assert not messages[0]
    (message,) = messages[1]
    off = re.search("from 2 images the lens distortion is known to about ([0-9.]+) pixels at the", message.text)
    assert float(off[1]) > 0.5


def test_four_images_are_not_few() -> None:
    given = grid_scene(2, 2, (0.5, 0.35), 0.5, seed=0, lens=Camera(SIZE, -0.25), noise=1.0, focal=420.0, per_link=40)
    found = aligned(given, lens="division3")
    assert radius_std(found.cameras[0], np.linspace(0.05, 1.0, 20))[-1] > 0.5
    assert "few-images" not in [message.code for message in found.messages]


def test_a_given_lens_is_not_doubted() -> None:
    lens = Camera(SIZE, -0.25)
    given = grid_scene(2, 1, (0.5, 0.35), 0.5, seed=0, lens=lens, noise=1.0, focal=420.0, per_link=60)
    cameras = [camera.with_coefficients(*lens.coefficients) for camera in given.cameras]
    assert not aligned(replace(given, cameras=cameras), lens_known=True).messages


@pytest.mark.parametrize("relief", sampled([0.04, 0.01]))
def test_relief_is_not_taken_for_lens(relief: float) -> None:
    found = aligned(lens_scene(Camera(SIZE, -0.05), 2, relief=relief))
    assert found.lens in ("division", "division-center")
    assert found.cameras[0].higher == ()


@pytest.mark.parametrize("seed", [2, 5])  # of these the first is told by the prior and the price, the second by either
def test_a_richer_lens_must_be_worth_its_price_and_not_be_far_off(seed: int) -> None:
    """Few matches over low hills: μ = .04 and a centre off by .08 half diagonals explain them somewhat better."""
    lens = Camera(SIZE, -0.05)
    given = grid_scene(
        2, 2, (0.35, 0.3), 0.3, seed=seed, lens=lens, focal=420.0, noise=0.3, outliers=0.0, per_link=60, relief=0.02
    )
    found = aligned(given)
    assert found.lens == "division"
    assert lens_distance(found.cameras[0], lens) < 1.0


def test_nothing_runs_away_where_there_are_no_matches() -> None:
    given = lens_scene(Camera(SIZE, -0.25), 3)
    middle = np.array([319.5, 239.5])
    links = []
    for link in given.links:
        near = [np.linalg.norm(points - middle, axis=1) < 150.0 for points in (link.points1, link.points2)]
        kept = near[0] & near[1]
        if kept.sum() >= 30:
            links.append(replace(link, points1=link.points1[kept], points2=link.points2[kept]))
    found = aligned(replace(given, links=links), lens="division3")
    camera = found.cameras[0]  # which could not be made if the lens folded the image
    assert found.lens == "division3"
    assert np.abs(np.array(camera.coefficients) - (-0.25, 0.0, 0.0)).max() < 0.3
    # The stated uncertainty covers what is not seen: the error at the corner is within it.
    assert radius_std(camera, np.linspace(0.05, 1.0, 20))[-1] > max(
        5.0, 0.3 * lens_distance(camera, Camera(SIZE, -0.25))
    )


@pytest.mark.parametrize("name", LENSES)
def test_a_lens_that_is_requested_is_estimated(name: str) -> None:
    found = aligned(lens_scene(FISHEYE, 4, columns=3, rows=2), lens=name)
    assert found.lens == name
    assert set(LENSES[name]) <= set(found.parameters)
    assert not (set(LENS_PARAMETERS) - set(LENSES[name])) & set(found.parameters)


def test_a_pair_keeps_the_centre_in_the_middle_and_says_so() -> None:
    lens = replace(FISHEYE, center=(319.5, 239.5))
    given = grid_scene(2, 1, (0.35, 0.35), 0.5, seed=6, lens=lens, noise=0.1, per_link=400, focal=420.0)
    found = aligned(given)
    assert found.lens in ("division2", "division3")
    assert found.cameras[0].center == (319.5, 239.5)
    assert "too few images to find the distortion centre" in found.lens_reason
    assert "distortion centre: the middle of the image" in described(found)


def test_a_known_lens_is_kept_whole() -> None:
    given = lens_scene(FISHEYE, 5, columns=3, rows=2)
    cameras = [
        replace(camera, center=FISHEYE.center).with_coefficients(*FISHEYE.coefficients) for camera in given.cameras
    ]
    found = aligned(replace(given, cameras=cameras), lens_known=True)
    assert found.cameras[0].coefficients == FISHEYE.coefficients
    assert found.cameras[0].center == pytest.approx(FISHEYE.center)
    assert found.distortion_std == 0.0
    assert found.rms < 0.6
    assert described(found) == (f"λ = {found.distortion:.6f}, given",)


def test_the_description_says_what_is_needed() -> None:
    plain = described(aligned(lens_scene(Camera(SIZE, -0.25), 0, columns=3, rows=2)))
    assert "±" in plain[0]
    assert "second coefficient not estimated" in plain
    strong = described(fisheye_alignment()[1])
    assert "nearest one-parameter lens" in strong[0]
    assert any(line.startswith("second coefficient μ = -0.0") for line in strong)
    assert any(line.startswith("centre 33") for line in strong)


SEEN = observations(independent_errors())
BASE = np.full(540, 1.0)


@pytest.mark.parametrize(
    ("freed", "name"),
    [
        ([1, 0, 0, 0, 0], "division"),
        ([1, 0, 0, 1, 1], "division-center"),
        ([1, 1, 0, 1, 1], "division2"),
        ([1, 1, 1, 1, 1], "division3"),
    ],
)
def test_a_lens_with_more_freed_is_the_next_that_has_it_all(freed: list[int], name: str) -> None:
    plain = LensChoice("division", free_parameters("division"), adjusted(SEEN, BASE), "enough")
    found = plain.refined(np.array(freed, dtype=np.bool_))
    assert found.name == name
    assert (found.free == np.array(freed, dtype=np.bool_)).all()
    assert (found is plain) is (name == "division")
    assert ("series" in found.reason) is (name == "division3")


observability = importlib.import_module("rdstitch.alignment.lens.observability")


def test_all_images_together_show_a_third_coefficient_that_pairs_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    given = lens_scene(replace(FISHEYE, distortion2=-0.03, distortion3=-0.03), 0)
    chosen = []

    def choose(links: LinkProblem, apart: Any, names: object) -> LensChoice:
        chosen.append(lens_selection.choose_lens(links, apart, ["division", "division2"]))
        return chosen[-1]

    monkeypatch.setattr(observability, "choose_lens", choose)
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


def pair(seed: int, *, distortion: float = 0.0, noise: float = 0.5, count: int = 80, depth: float = 0.0) -> Scene:
    """Two images; ``depth`` moves the matches of the second by so many pixels, together where they are neighbours."""
    lens = Camera(SIZE, distortion)
    given = grid_scene(
        2, 1, (0.3, 0.3), 0.3, seed=seed, lens=lens, noise=noise, focal=420.0, per_link=count, outliers=0.0
    )
    (link,) = given.links
    places = lens.normalize(link.points1)
    moved = np.column_stack([np.sin(4.0 * places[:, 1]), 3.0 * (places**2).sum(axis=1) * places[:, 1]])
    return replace(given, links=[replace(link, points2=link.points2 + depth * moved)])


def unweighed(given: Scene, monkeypatch: pytest.MonkeyPatch) -> Alignment:
    with monkeypatch.context() as without:
        without.setattr(importlib.import_module("rdstitch.alignment.recipe"), "weigh_lens", lambda problem, fit, _: fit)
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


def test_a_guessed_focal_length_is_that_of_fisheyes_with_as_much_barrel_distortion() -> None:
    guessed = AlignmentOptions().camera_priors([Camera(SIZE).with_guessed_focal()])
    equidistant = -(0.8**-2.0) / 3.0  # λ where the focal length is 0.8 half diagonals
    assert guessed.with_lens(equidistant).log_focal == pytest.approx(math.log(0.8), abs=0.1)
    for distortion in (-0.1, 0.0, 0.2):
        assert guessed.with_lens(distortion).log_focal == pytest.approx(math.log(1.2))
    of_exif = AlignmentOptions().camera_priors([Camera(SIZE).with_focal(500.0, "exif")])
    assert of_exif.with_lens(equidistant) == of_exif
