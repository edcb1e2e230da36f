"""Layouts that are chosen by their seams, and what is said of those that break."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from examples.worlds.trust_sets import judge_set, trust_set
from rdstitch.arrays import FloatArray
from rdstitch.compositing import CompositeOptions, SeamBreak, SeamQuality
from rdstitch.io.write import write_image
from rdstitch.local_alignment import no_local_alignment
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.composition.choose_layout import _alternatives, _differs, _error, _Trials, choose_layout
from rdstitch.pipeline.composition.compose import CanvasLayout
from rdstitch.pipeline.composition.lay_out import is_stretched
from rdstitch.pipeline.composition.output_messages import seam_messages
from rdstitch.pipeline.recipes import mosaic, pano
from rdstitch.pipeline.registration.aligner import Aligner
from rdstitch.pipeline.registration.realign import aligner_of, by_second_motions
from rdstitch.pipeline.run import Run
from rdstitch.results.placed_images import PlacedImages
from rdstitch.results.registration import Registration
from rdstitch.synthetic.textures import ground
from tests.registrations import CAMERA, registered, registration, source


def _of_two_surfaces(folder: Path) -> list[Path]:
    """Two images of ground whose lowest part, with kerbs, is nearer."""
    light = ground((760, 480), seed=5).region(0, 0, 760, 480)
    scene = np.rint(light * (255.0 / light.max())).astype(np.uint8)
    for top in range(340, 470, 30):  # kerbs
        scene[top : top + 8] = 255 * (top % 60 == 40)
    near = np.roll(scene, (13, 9), (0, 1))
    second = np.concatenate([scene[:330], near[330:]])[:, 240:]
    paths = [folder / name for name in ("a.png", "b.png")]
    for path, pixels in zip(paths, (scene[:, :520], second), strict=True):
        write_image(path, pixels)
    return paths


OPTIONS = StitchOptions(workers=1, local_alignment="off", model="rigid", distortion=0.0)


def _aligned_by_both(folder: Path) -> tuple[Registration, Registration, Aligner]:
    """By either surface, the farther one first."""
    far = registered(_of_two_surfaces(folder), OPTIONS, focal=None)
    aligner = aligner_of(far, Run(OPTIONS))
    near = by_second_motions(far, [(0, 1)], aligner)
    assert near is not None
    return far, near, aligner


@pytest.mark.parametrize("scale", [1.0, 0.2])  # seams are judged by the images, whatever the size of the output
def test_where_a_part_of_the_scene_is_nearer_one_line_says_where_its_lines_break(scale: float, tmp_path: Path) -> None:
    composite = CompositeOptions(scale=scale)
    result = pano(_of_two_surfaces(tmp_path), options=StitchOptions(local_alignment="off", composite=composite))
    assert result.ok
    (warning,) = [message for message in result.messages if message.severity == "warning"]
    assert warning.code == "seam-break"
    longest = result.seams.breaks[0]
    assert (
        "a break of {:.0f} pixels at ({:.0f}, {:.0f}), between".format(longest.length, *longest.position)
        in warning.text
    )
    assert (result.seams.places[result.seams.broken, 1] > 300 * scale).all()
    assert len(result.seams.places) > 25


def test_images_aligned_by_the_surface_whose_seams_break_are_aligned_by_the_other(tmp_path: Path) -> None:
    far, near, aligner = _aligned_by_both(tmp_path)
    offsets = [one.alignment.transfer(0, 1, np.array([[380.0, 240.0]]))[0] for one in (far, near)]
    np.testing.assert_allclose(offsets[1] - offsets[0], [9.0, 13.0], atol=0.5)
    assert _error(near) < 1.0
    assert _error(replace(far, alignment=near.alignment)) > 10.0  # the far matches count, though none of them fits
    for given in (far, near):
        chosen = choose_layout(given, OPTIONS, aligner).registration.alignment
        np.testing.assert_allclose(chosen.transfer(0, 1, np.array([[380.0, 240.0]]))[0], offsets[0], atol=0.1)


@pytest.mark.parametrize("by_heights", [False, True])
def test_where_heights_of_the_ground_explain_parallax_no_other_model_is_tried(by_heights: bool, tmp_path: Path) -> None:
    _, near, aligner = _aligned_by_both(tmp_path)
    trials = _Trials(OPTIONS, False, lambda image: np.empty((0, 2, 2)))
    first = trials.judge(near, replace(no_local_alignment(""), by_heights=by_heights))
    assert first.faults
    assert bool(list(_alternatives(near, first, trials, aligner))) is not by_heights


def test_what_a_homography_stretches_is_laid_out_as_a_turn(shared_data: Callable[[str], Path]) -> None:
    result = mosaic([shared_data("cases/picture_smear_school")])
    assert result.registration.alignment.model == "rotation"
    assert not result.seams.broken_at_reference_size
    assert result.registration.alignment.used.all()


def test_local_alignment_whose_seams_nobody_can_judge_is_left_out(shared_data: Callable[[str], Path]) -> None:
    """Fields bend the table towards the wall, and the seam runs where one image ends."""
    result = pano([shared_data("classical/DFW_desk")])
    assert len(result.seams.places) > 20
    assert not result.seams.broken.any()


def test_a_passing_vehicle_makes_no_turn_of_a_plane(tmp_path: Path) -> None:
    """It breaks the seams of a plane that fits to 0.16 pixels; those of a turn of 0.56 go round it, 1.6 pixels off."""
    assert judge_set(trust_set(12, "vehicle"), tmp_path).right


@pytest.mark.parametrize(("tilt", "stretched"), [(0.0, False), (0.4, False), (0.9, True)])
def test_a_plane_seen_from_the_sideis_stretched(tilt: float, stretched: bool) -> None:
    oblique = np.eye(3)
    oblique[2, 0] = tilt
    placed = PlacedImages([source(), source()], np.stack([np.eye(3), oblique]), 0)
    assert is_stretched(CanvasLayout.of(placed, CompositeOptions())) is stretched


def _quality(*breaks: SeamBreak, alike: float = 0.9) -> SeamQuality:
    broken = np.arange(100) < len(breaks)
    return SeamQuality(np.zeros((100, 2)), broken, broken, breaks, breaks, 8.0, alike, least_alike=(0, 2))


def _break(pair: tuple[int, int], length: float) -> SeamBreak:
    return SeamBreak(pair, (10.0, 20.0), length, 5.0)


def test_a_break_that_a_person_sees_is_one_warning_and_others_a_detail() -> None:
    paths = ["in/a.jpg", "in/b.jpg", "in/c.jpg"]
    assert seam_messages(_quality(), paths) == []
    (detail,) = seam_messages(_quality(_break((0, 1), 44.0)), paths)
    assert detail.severity == "detail"
    (warning,) = seam_messages(_quality(_break((1, 2), 46.0), _break((0, 1), 30.0), _break((1, 2), 9.0)), paths)
    assert warning.severity == "warning"
    assert warning.images == ("in/b.jpg", "in/c.jpg", "in/a.jpg")
    assert "a break of 46 pixels at (10, 20), between b.jpg and c.jpg; a break of 30 pixels" in warning.text
    assert "and 1 more" in warning.text
    for nothing_holds in (_quality(_break((1, 2), 46.0), alike=0.49), SeamQuality(alike=0.49, least_alike=(0, 2))):
        (unlike,) = seam_messages(nothing_holds, paths)
    assert seam_messages(_quality(alike=0.49), paths) == []  # clouds drift, and the seams go around them
    assert (unlike.severity, unlike.code) == ("warning", "rival-motion")
    assert "only 49% of what the images share looks alike, the least between a.jpg and c.jpg" in unlike.text


@pytest.mark.parametrize(("unseen", "differs"), [(0.02, False), (0.2, True)])
def test_a_few_places_that_a_lens_cannot_see_are_no_other_layout(unseen: float, differs: bool) -> None:
    given = registration(2, homographies=np.stack([np.eye(3)] * 2))

    def transfer(i: int, j: int, points: FloatArray) -> FloatArray:
        places = given.alignment.transfer(i, j, points)
        inside = np.flatnonzero(((places >= 0.0) & (places < CAMERA.image_size)).all(axis=1))
        places[inside[: math.ceil(unseen * len(inside))]] = np.nan
        return places

    other: Any = SimpleNamespace(used=given.alignment.used, transfer=transfer)
    assert _differs(given, math.inf, other, stretched=False) is differs
