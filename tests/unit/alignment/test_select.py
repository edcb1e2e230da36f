"""Turn, plane or neither: what is chosen, on matches of known motions."""

import math
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from examples.worlds.alignment_scenes import aligned, fitted, grid, grid_scene, scene, turn_links
from examples.worlds.turns import camera_rotations
from rdstitch.alignment import Alignment, AlignmentOptions, align
from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.motion_models import HOMOGRAPHY, PSI, RIGID, ROTATION, MotionModel
from rdstitch.alignment.select import Hypothesis, ModelChoice, Posterior, _best, select_model
from rdstitch.arrays import FloatArray
from rdstitch.choices import Purpose
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.links import Link

SIZE, FOCAL = (640, 480), 520.0


def _views(
    rotations: FloatArray,
    positions: FloatArray,
    depth: tuple[float, float],
    *,
    camera: Camera | None = None,
    lens: Camera | None = None,
    seed: int = 0,
    count: int = 150,
) -> tuple[list[Camera], list[Link]]:
    """Links between images of a scene whose depth grows from the first to the second value, upwards in the images."""
    lens = lens or Camera(SIZE)
    given = camera or Camera(SIZE, focal=FOCAL, focal_source="guess")
    rng, links = np.random.default_rng(seed), []
    for i in range(len(rotations)):
        for j in range(i + 1, len(rotations)):
            first = rng.uniform((0, 0), np.array(SIZE) - 1.0, (4 * count, 2))
            rays = np.column_stack([(lens.undistort(first) - lens.center) / FOCAL, np.ones(len(first))])
            share = 1.0 - first[:, 1] / SIZE[1]
            along = depth[0] * (depth[1] / depth[0]) ** share * np.where(first[:, 0] % 160 < 80, 1.0, 1.05)
            seen = (rays * along[:, None]) @ rotations[i] + positions[i]
            other = (seen - positions[j]) @ rotations[j].T
            second = lens.distort(other[:, :2] / other[:, 2:] * FOCAL + lens.center)
            inside = (other[:, 2] > 0.0) & ((second >= 0.0) & (second <= np.array(SIZE) - 1.0)).all(axis=1)
            if inside.sum() < count:
                continue
            p1, p2 = (p[inside][:count] + rng.normal(0.0, 0.2, (count, 2)) for p in (first, second))
            k = np.diag([FOCAL / lens.scale, FOCAL / lens.scale, 1.0])
            relation = RadialHomography(
                k @ rotations[j] @ rotations[i].T @ np.linalg.inv(k), given, given, np.ones(count, dtype=np.bool_)
            )
            links.append(Link(i, j, p1, p2, replace(relation, distortion_std=0.02)))
    return [given] * len(rotations), links


def _turn(step: float, *, pitch: float = 0.0, moved: float = 0.0, **options: object) -> tuple[list[Camera], list[Link]]:
    """Five images of a turn by steps of so many degrees, of a scene from 5 to 50 units away."""
    headings = np.radians(step) * np.arange(5)
    rotations = camera_rotations(headings.tolist(), [np.radians(pitch)] * 5)
    positions = moved * np.random.default_rng(3).normal(size=(5, 3))
    return _views(rotations, positions, (5.0, 50.0), **options)  # type: ignore[arg-type]


def _focal_error(found: Alignment) -> float:
    return abs(found.focal * Camera(SIZE).scale / FOCAL - 1.0)


@pytest.mark.parametrize("moved", [0.0, 0.03])
@pytest.mark.parametrize("pitch", [0.0, 50.0])
def test_a_turn_by_hand_is_a_turn(moved: float, pitch: float) -> None:
    found = align(*_turn(20.0, moved=moved, pitch=pitch))
    assert found.model == "rotation"
    assert found.used.all()
    assert abs(found.distortion) < 0.03
    assert _focal_error(found) < 0.05


@pytest.mark.parametrize("factor", [0.3, 8.0])
def test_images_overrule_a_focal_length_of_exif_that_is_nonsense(factor: float) -> None:
    wrong = Camera(SIZE, focal=factor * FOCAL, focal_source="exif")
    found = align(*_turn(20.0, camera=wrong))
    assert found.model == "rotation"
    assert _focal_error(found) < 0.05


def test_a_wide_lens_on_a_turn_is_found() -> None:
    found = align(*_turn(20.0, lens=Camera(SIZE, distortion=-0.25)))
    assert found.model == "rotation"
    assert found.distortion == pytest.approx(-0.25, abs=0.02)


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_a_camera_that_moves_over_a_plane_does_not_turn(tilt: float) -> None:
    given = grid_scene(3, 2, (0.4, 0.35), 0.3, seed=4, tilt=(tilt, 0.0), focal_source="guess", per_link=120)
    found = aligned(given)
    assert found.model == "rigid"
    assert found.tilt[0] == pytest.approx(tilt, abs=0.03)
    assert found.distortion == pytest.approx(-0.25, abs=0.01)


def test_tilts_of_their_own_are_found() -> None:
    rng = np.random.default_rng(5)
    poses = grid(3, 3, (0.4, 0.35), 0.3, rng)
    poses[:, PSI] = np.radians([0, 4, -5, 6, -3, 2, -6, 5, 1])
    given = scene(poses, rng=rng, focal_source="guess", per_link=120)
    assert aligned(given).model == "tilting"


def test_depth_in_two_images_is_not_taken_for_a_lens() -> None:
    """Something near at the bottom and far at the top, from two places."""
    rotations = camera_rotations([0.0, np.radians(8.0)], [0.0, 0.0])
    given = _views(rotations, np.array([[0.0, 0.0, 0.0], [0.25, 0.0, 0.1]]), (4.0, 12.0))
    found = align(*given)
    assert found.distortion == 0.0
    assert [message.severity for message in found.messages if "depth" in message.text] == ["detail"]
    lens = align(*given, AlignmentOptions(purpose=Purpose.CALIBRATE))
    assert [message.severity for message in lens.messages if "depth" in message.text] == ["failure"]


def _posterior(count: int) -> tuple[Posterior, Fit]:
    """Of images over a plane; seams hide a quarter of 4 pixels, and the noise: 1.17 pixels."""
    rng = np.random.default_rng(0)
    problem, fit = fitted(scene(grid(count, 1, (0.4, 0.3), 0.2, rng), rng=rng))
    posterior = Posterior(problem)
    vars(posterior)["evidence"] = replace(posterior.evidence, farthest=np.array([4.0]), noise=np.array([0.6]))
    return posterior, fit


@pytest.mark.parametrize(
    ("stretch", "plane", "turn", "chosen"),
    [
        (20.0, 0.9, 1.1, "rotation"),  # what seams hide
        (20.0, 0.9, 1.5, "homography"),
        (math.inf, 0.9, 1.5, "homography"),
        (7.0, 0.9, 1.1, "rigid"),  # homographies add up their errors, and show no more of the scene
        (7.0, 1.2, 1.1, "homography"),
    ],
)
def test_one_camera_may_leave_what_seams_hide(stretch: float, plane: float, turn: float, chosen: str) -> None:
    posterior, fit = _posterior(3)

    def hypothesis(model: MotionModel, cost: float, field: float) -> Hypothesis:
        return Hypothesis(replace(fit, model=model), cost, field, stretch if model is RIGID else 1.0)

    tried = [hypothesis(ROTATION, 60.0, turn), hypothesis(RIGID, 0.0, plane), hypothesis(HOMOGRAPHY, -30.0, 0.2)]
    assert _best(posterior, tried).fit.model.name == chosen


@pytest.mark.parametrize(
    ("turn", "field", "chosen"), [(3.0, 1.1, "rotation"), (3.0, 1.5, "homography"), (9.0, 1.1, "homography")]
)
def test_of_two_images_a_turn_is_taken_where_a_homography_is_hardly_more_probable(
    turn: float, field: float, chosen: str
) -> None:
    posterior, fit = _posterior(2)
    tried = [
        Hypothesis(replace(fit, model=model), cost, errors, 1.0)
        for model, cost, errors in ((ROTATION, turn, field), (RIGID, 80.0, 4.0), (HOMOGRAPHY, 0.0, 0.2))
    ]
    assert _best(posterior, tried).fit.model.name == chosen


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("purpose", [Purpose.MOSAIC, Purpose.CALIBRATE])
def test_two_images_of_a_turn_with_few_matches_are_a_turn(seed: int, purpose: Purpose) -> None:
    """A homography fits them better, by no more than its parameters cost."""
    rotations = camera_rotations(np.radians([0.0, 15.0]), [0.1, 0.1])
    links = turn_links(Camera(SIZE, -0.05, focal=FOCAL), rotations, np.random.default_rng(seed), 0.5, 60)
    cameras = [Camera(SIZE, focal=FOCAL, focal_source="guess")] * 2
    assert align(cameras, links, AlignmentOptions(purpose=purpose)).model == "rotation"


@pytest.mark.parametrize("seed", range(3))
def test_a_plane_is_no_turn_of_a_camera_with_an_endless_focal_length(seed: int) -> None:
    """Short steps without a turn: rays of a long lens move as much, by two parameters less; a tilt has four more."""
    given = grid_scene(
        3, 1, (0.08, 0.08), 0.0, seed=seed, lens=Camera(SIZE, -0.05), focal=480.0, focal_source="guess", noise=1.0,
        outliers=0.0, per_link=40,
    )  # fmt: skip
    found = aligned(given)
    assert found.model == "rigid"


def test_a_model_that_was_requested_is_taken() -> None:
    found = align(*_turn(12.0), AlignmentOptions(model="similarity"))
    assert found.model == "similarity"
    assert "as requested" in found.model_reason


def test_the_command_decides_between_what_is_as_good(monkeypatch: pytest.MonkeyPatch) -> None:
    """`pano` is for turns, `mosaic` for planes: odds that evidence overrules."""
    costs = []

    def spy(problem: Problem, names: list[str], *rest: object) -> ModelChoice:
        choice = select_model(problem, ["rotation"])
        costs.append(
            [Posterior(problem, purpose).hypothesis(choice.fit).cost for purpose in (Purpose.PANO, Purpose.MOSAIC)]
        )
        return choice

    monkeypatch.setattr(import_module("rdstitch.alignment.recipe"), "select_model", spy)
    align(*_turn(20.0))
    assert 2.0 < costs[0][1] - costs[0][0] < 10.0
