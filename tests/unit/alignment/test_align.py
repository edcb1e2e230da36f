"""The whole adjustment, on links synthesised from known poses: does it find the model, the camera and the poses?"""

import math
from dataclasses import replace
from importlib import import_module
from typing import Any, cast, get_args

import numpy as np
import pytest

from examples.judging.trajectories import compare_trajectories
from examples.worlds.alignment_scenes import Scene, aligned, grid, grid_scene, jittered, robot_path, scene
from rdstitch.alignment import AlignmentOptions, AlignmentTask, align, most_matches_read
from rdstitch.alignment.build_result import AdjustedImages, _nearest_distortion_std, build_alignment
from rdstitch.alignment.frames.reference_frame import in_frame_of
from rdstitch.alignment.least_squares.plane_marks import Sighting
from rdstitch.alignment.motion_models import LOG_HEIGHT, PSI, THETA, YAW, X, Y
from rdstitch.alignment.result import Alignment, PlanarPoses, Unused
from rdstitch.alignment.sentences import explain_unaligned
from rdstitch.arrays import FloatArray
from rdstitch.choices import LensName, ModelName, Purpose
from rdstitch.errors import ArgumentError, RdstitchError, RegistrationError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import PlanarMotion
from rdstitch.geometry.radial_homography import RadialHomography, transfer
from rdstitch.matching.links import Link
from rdstitch.matching.match_graph import SpanningTree, spanning_tree
from rdstitch.trajectories.trajectory import Trajectory
from tests.sampled import sampled


def _pair_errors(found: Alignment, truth: Scene) -> np.ndarray:
    """Distance between where a link's points should be and where the alignment puts them, px."""
    errors = []
    for link, fit in zip(truth.links, found.links, strict=True):
        if fit.used:
            camera = truth.cameras[link.image1]
            x = camera.normalize(link.points1)
            right = truth.truth[link.image2] @ np.linalg.inv(truth.truth[link.image1])
            should = transfer(right, truth.distortion, x)
            center = (np.array(found.cameras[0].center) - camera.center) / camera.scale
            own = found.relation(link.image1, link.image2)
            there = transfer(own, found.distortion, x - center) + center
            errors.append(np.linalg.norm(there - should, axis=1) * camera.scale)
    return np.concatenate(errors)


def _true_path(truth: Scene) -> Trajectory:
    p = truth.poses
    return Trajectory.from_poses(PlanarPoses(p[:, YAW], p[:, [X, Y]], np.exp(p[:, LOG_HEIGHT]), p[:, [PSI, THETA]]))


def _wrong_link(given: Scene, i: int, j: int, rng: np.random.Generator) -> Link:
    """A pair that fits perfectly, but for the wrong motion: repeated structure."""
    camera = replace(given.cameras[0], distortion=given.distortion, distortion_std=0.01)
    focal = np.diag([1.3, 1.3, 1.0])
    motion = PlanarMotion((0.04, -0.03), rng.uniform(-0.3, 0.3), (rng.uniform(-0.3, 0.3), 0.1))
    h = focal @ motion.homography() @ np.linalg.inv(focal)
    width, height = camera.image_size
    p = rng.uniform((0.0, 0.0), (width - 1, height - 1), (300, 2))
    q = camera.denormalize(transfer(h, given.distortion, camera.normalize(p)))
    inside = np.isfinite(q).all(axis=1) & (q >= 0).all(axis=1) & (q <= (width - 1, height - 1)).all(axis=1)
    p, q = p[inside][:100], q[inside][:100] + rng.normal(0, 0.3, (100, 2))
    relation = RadialHomography(h, camera, camera, np.ones(100, dtype=np.bool_), distortion_std=0.01, rms=0.4)
    return Link(i, j, p, q, relation)


_OPTIONS: list[dict[str, object]] = [
    {"tilt": (0.05, -0.03)},
    {"attitudes": np.zeros((4, 2))},
    {"attitudes": np.zeros((4, 2)), "attitudes_std": 0.01},
    {"gravity": np.tile([0.0, 0.0, 1.0], (4, 1))},
    {"positions": np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 2.0], [3.0, 2.0]]), "positions_std": np.ones(4)},
    {"lens_known": True},
    {"reference": 3},
    {"pose_covariance": True},
    *[dict[str, object](lens=lens) for lens in get_args(LensName)],
    *[dict[str, object](purpose=purpose) for purpose in Purpose],
]


@pytest.mark.slow
@pytest.mark.parametrize("model", get_args(ModelName))
def test_every_model_goes_with_every_option_or_says_why_not(model: str) -> None:
    given = grid_scene(2, 2, seed=1, per_link=40)
    for options in _OPTIONS:
        try:
            found = aligned(given, model=model, **options)
        except RdstitchError:
            continue
        assert np.isfinite(found.homographies).all(), options
        assert (np.abs(np.linalg.det(found.homographies)) > 1e-6).all(), options


@pytest.mark.parametrize(
    ("cells", "size", "focal", "distortion", "deg", "yaw"),
    [
        ((4, 3), (640, 480), 520.0, -0.25, (2.5, -2.0), 8.0),
        ((6, 2), (800, 600), 650.0, -0.25, (2.0, -1.5), 8.0),
        ((4, 3), (640, 480), 420.0, -0.45, (-6.0, 5.0), 15.0),
        ((4, 3), (640, 480), 520.0, 0.0, (0.0, 0.0), 180.0),
    ],
)
def test_a_robots_grid_is_rigid(
    cells: tuple[int, int], size: tuple[int, int], focal: float, distortion: float, deg: tuple[float, float], yaw: float
) -> None:
    tilt = (math.radians(deg[0]), math.radians(deg[1]))
    given = grid_scene(
        *cells, (0.5, 0.4), math.radians(yaw), seed=cells[0], size=size, focal=focal, distortion=distortion, tilt=tilt
    )
    found = aligned(given)
    assert found.model == "rigid"
    assert found.used.all()
    assert abs(found.distortion - distortion) < 0.001
    assert abs(found.distortion - distortion) < 5 * found.distortion_std
    assert found.tilt == pytest.approx(tilt, abs=math.radians(0.1))
    assert float(np.quantile(_pair_errors(found, given), 0.95)) < 0.2
    assert compare_trajectories(Trajectory.from_alignment(found), _true_path(given)).drift < 1e-3
    assert not found.relief.found
    assert found.messages == ()


@pytest.mark.parametrize(("height", "tilt", "model"), [(0.2, 0.0, "similarity"), (0.2, 3.0, "tilting")])
def test_a_drone_needs_more_freedom(height: float, tilt: float, model: str) -> None:
    wind = height, math.radians(tilt)
    given = grid_scene(4, 3, yaw=0.25, seed=2, tilt=(0.04, -0.03), focal_source="exif", per_link=120, wind=wind)
    found = aligned(given)
    assert found.model == model
    assert abs(found.distortion + 0.25) < 0.001
    assert float(np.quantile(_pair_errors(found, given), 0.95)) < 0.2
    ratio = found.poses.height / np.exp(given.poses[:, LOG_HEIGHT])
    assert float(np.std(ratio) / np.mean(ratio)) < 0.005
    if tilt:
        assert found.tilt_spread == pytest.approx(float(np.sqrt(np.mean(given.poses[:, [PSI, THETA]] ** 2))), rel=0.25)


def test_focal_length_that_is_guessed_wrong_is_found() -> None:
    given = grid_scene(4, 3, (0.5, 0.4), 0.3, seed=4, tilt=(0.1, -0.08), guess=690.0, focal_source="guess")
    found = aligned(given)
    true = 520.0 / given.cameras[0].scale
    assert found.focal_std < 0.05 * true
    assert abs(found.focal - true) < 4 * found.focal_std
    assert found.cameras[0].focal_source == "estimate"


def test_an_off_centre_lens_is_noticed_and_a_centred_one_left_alone() -> None:
    given = grid_scene(3, 3, yaw=0.3, seed=6, per_link=120)
    shift = np.array([14.0, -9.0])
    moved = [replace(link, points1=link.points1 + shift, points2=link.points2 + shift) for link in given.links]
    found = align(given.cameras, moved)
    assert found.support is found.support, "it is asked for every pair of thousands"
    middle = np.array(given.cameras[0].center)
    np.testing.assert_allclose(np.array(found.cameras[0].center) - middle, shift, atol=1.0)
    assert abs(found.distortion + 0.25) < 0.001
    np.testing.assert_array_equal(aligned(given).cameras[0].center, middle)


@pytest.mark.parametrize("model", ["auto", "homography"])
def test_wrong_pairs_are_dropped_by_name(model: str) -> None:
    rng = np.random.default_rng(7)
    given = scene(robot_path(40, 0.2), tilt=(-0.1, 0.08), rng=rng, overlap=0.3, reach=3, per_link=80)
    wrong = [(2, 35), (10, 30), (20, 38)]
    given = replace(given, links=[*given.links, *(_wrong_link(given, i, j, rng) for i, j in wrong)])
    found = aligned(given, model=model)
    dropped = {(fit.image1, fit.image2) for fit in found.links if not fit.used}
    assert dropped == set(wrong)
    assert all("contradicts" in fit.reason for fit in found.links if not fit.used)
    assert found.used.all()
    assert float(np.quantile(_pair_errors(found, given), 0.95)) < 0.3


def test_images_without_connection_are_named() -> None:
    rng = np.random.default_rng(8)
    poses = np.concatenate([grid(3, 2, (0.4, 0.3), 0.2, rng), grid(2, 1, (0.4, 0.3), 0.2, rng), np.zeros((1, 6))])
    poses[6:8, X] += 50.0
    poses[8, X] = 100.0
    found = aligned(scene(poses, rng=rng))
    assert found.used.tolist() == [True] * 6 + [False] * 3
    assert found.components == ((0, 1, 2, 3, 4, 5), (6, 7), (8,))
    reasons = {
        message.images: message.text
        for message in explain_unaligned(found, [f"{k}.png" for k in range(9)], [900] * 9, {})
    }
    assert list(reasons) == [("6.png",), ("7.png",), ("8.png",)]
    assert reasons["6.png",].startswith("in block 2 of 2, whose 2 images overlap too little with the others")
    assert reasons["7.png",] == reasons["6.png",]
    assert "no reliable overlap" in reasons["8.png",]
    blurred = explain_unaligned(found, [f"{k}.png" for k in range(9)], [900] * 8 + [290], {})
    assert [message.images for message in blurred if "(blurred?)" in message.text] == [("8.png",)]
    assert np.isnan(found.homographies[6:]).all()
    assert np.isfinite(found.homographies[:6]).all()


def test_turning_on_the_spot_says_nothing_of_the_lens() -> None:
    rng = np.random.default_rng(9)
    poses = np.zeros((5, 6))
    poses[:, YAW] = np.linspace(0, 1.5, 5)
    given = scene(poses, distortion=-0.2, rng=rng)
    # A picture needs no lens, and a path only what is known of it.
    wanted = {Purpose.MOSAIC: "detail", Purpose.TRAJECTORY: "warning", Purpose.CALIBRATE: "failure"}
    for purpose, severity in wanted.items():
        found = aligned(given, purpose=purpose)
        assert math.isinf(found.distortion_std)
        assert found.lens_reason == "λ is not observable"
        assert {m.severity for m in found.messages if m.code == "lambda-not-observable"} == {severity}


def test_hills_are_noticed() -> None:
    found = aligned(grid_scene(4, 3, wind=(0.1, 0.03), seed=10, relief=0.05))
    assert found.relief.found
    assert found.relief.coherence > 0.6
    assert "not one plane" in found.relief.explanation


def test_known_lens_and_tilt_are_kept() -> None:
    given = grid_scene(3, 2, seed=11, tilt=(0.05, -0.04))
    cameras = [replace(camera, distortion=-0.25) for camera in given.cameras]
    found = aligned(replace(given, cameras=cameras), lens_known=True, tilt=(0.05, -0.04))
    assert found.distortion == -0.25
    assert found.distortion_std == 0.0
    assert found.tilt == pytest.approx((0.05, -0.04), abs=1e-5)


@pytest.mark.parametrize(("std", "model"), [(0.0, "similarity"), (0.01, "tilting")])
def test_measured_attitudes_replace_estimated_ones(std: float, model: str) -> None:
    rng = np.random.default_rng(12)
    poses = jittered(grid(4, 3, (0.4, 0.3), 0.2, rng), 0.1, 0.05, rng)
    given = scene(poses, tilt=(0.03, 0.02), rng=rng)
    attitudes = poses[:, [PSI, THETA]] + std * rng.normal(size=(len(poses), 2))
    found = aligned(given, attitudes=attitudes, attitudes_std=std)
    assert found.model == model
    np.testing.assert_allclose(found.poses.tilt, poses[:, [PSI, THETA]] + (0.03, 0.02), atol=0.005)
    assert float(np.quantile(_pair_errors(found, given), 0.95)) < 0.2


def test_the_reference_image_is_the_frame() -> None:
    given = grid_scene(3, 2, seed=13)
    for model in ("similarity", "homography"):
        found = aligned(given, model=model, reference=4)
        assert found.reference == 4
    np.testing.assert_allclose(found.homographies[4], np.eye(3), atol=1e-12)
    rigid = aligned(given, model="rigid", reference=4)
    np.testing.assert_allclose([rigid.poses.yaw[4], *rigid.poses.position[4], rigid.poses.height[4]], [0, 0, 0, 1])


def test_a_reduced_image_is_the_reference_only_where_it_is_named() -> None:
    given = scene(grid(3, 1, (0.4, 0.3), 0.2, np.random.default_rng(13)), rng=np.random.default_rng(14))
    middle = aligned(given, model="similarity").reference
    small = given.cameras[middle].resized((320, 240))
    cameras = [small if k == middle else camera for k, camera in enumerate(given.cameras)]
    half = {True: 0.5, False: 1.0}
    links = [
        replace(
            link,
            points1=(link.points1 + 0.5) * half[link.image1 == middle] - 0.5,
            points2=(link.points2 + 0.5) * half[link.image2 == middle] - 0.5,
        )
        for link in given.links
    ]
    reduced = replace(given, cameras=cameras, links=links)
    assert middle == 1
    assert aligned(reduced, model="similarity").reference in (0, 2)
    assert aligned(reduced, model="similarity", reference=middle).reference == middle


def test_any_image_can_become_the_frame_after_the_adjustment(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adjustment may have held another one, turned and at another height: then the frame is changed."""
    given = grid_scene(3, 2, yaw=1.2, wind=(0.2, 0.0), seed=12, tilt=(0.05, -0.04))
    poses = given.poses
    adjusted: list[AdjustedImages] = []
    recipe = import_module("rdstitch.alignment.recipe")

    def kept(images: AdjustedImages) -> Alignment:
        adjusted.append(images)
        return build_alignment(images)

    monkeypatch.setattr(recipe, "build_alignment", kept)
    aligned(given, model="similarity", reference=0)
    for reference in range(len(poses)):
        found = build_alignment(replace(adjusted[0], problem=replace(adjusted[0].problem, fixed=reference)))
        own, height = poses[reference], np.exp(poses[reference, LOG_HEIGHT])
        c, s = np.cos(own[YAW]), np.sin(own[YAW])
        expected = (poses[:, [X, Y]] - own[[X, Y]]) @ np.array([[c, s], [-s, c]]) / height
        np.testing.assert_allclose(found.poses.position, expected, atol=0.01)
        np.testing.assert_allclose(found.poses.height, np.exp(poses[:, LOG_HEIGHT]) / height, rtol=0.01)
        assert found.poses.yaw[reference] == 0.0
        lower = in_frame_of(replace(found, lever_std=0.3), (reference + 1) % len(poses))
        assert lower.lever_std == pytest.approx(0.3 / found.poses.height[lower.reference])
        # Where images lie to one another stays as it is.
        assert float(np.quantile(_pair_errors(found, given), 0.95)) < 0.3


def test_of_links_with_as_many_matches_those_that_overlap_most_are_chained(monkeypatch: pytest.MonkeyPatch) -> None:
    """By every fifth image, neighbours would be joined far away only, after all that the chains have drifted."""
    module, trees = import_module("rdstitch.alignment.adjustment_problem"), []

    def noted(*given: object) -> SpanningTree:
        trees.append(spanning_tree(*given))  # type: ignore[arg-type]
        return trees[-1]

    monkeypatch.setattr(module, "spanning_tree", noted)
    rng = np.random.default_rng(5)
    path = robot_path(40, 0.15)
    made = scene(path, tilt=(-0.1, 0.087), noise=0.4, overlap=0.3, reach=5, per_link=150, rng=rng)
    assert aligned(made, model="rigid").used.all()
    assert trees
    assert max(np.abs(tree.parent - tree.child).mean() for tree in trees) < 1.5


def test_the_order_of_links_does_not_matter() -> None:
    given = grid_scene(3, 2, seed=14)
    there, back = aligned(given), align(given.cameras, given.links[::-1])
    assert there.distortion == pytest.approx(back.distortion, abs=1e-5)
    assert there.model == back.model


@pytest.mark.parametrize(("most", "read"), sampled([(40, None), (200, 200)]))
def test_links_need_no_more_matches_than_are_read(most: int, read: int | None) -> None:
    given = grid_scene(5, 4, yaw=0.1, seed=5, per_link=220)
    options = AlignmentOptions(max_matches_per_link=most, lens="division")
    assert most_matches_read(len(given.links), options) == read
    few = align(given.cameras, [link.thinned(read) for link in given.links], options)
    every = align(given.cameras, given.links, options)
    assert np.array_equal(few.homographies, every.homographies)
    assert few.links == every.links
    # Many links are read in part, and those of a short turn whole.
    options = AlignmentOptions(max_matches_per_link=100)
    assert [most_matches_read(links, options) for links in (10, 100, 6000, 50_000)] == [None, 100, 83, 40]


def test_a_lens_at_the_limit_of_folding_has_a_deviation() -> None:
    found = _nearest_distortion_std(Camera((640, 480), 0.999995), np.diag([1e-4, 0.0, 0.0]))
    assert found == pytest.approx(0.01, rel=1e-3)


def test_mistakes_of_the_caller() -> None:
    given = grid_scene(2, 1, seed=15)
    cameras, (link,) = given.cameras, given.links
    failed = RadialHomography.failed("none", Camera((4, 3)), Camera((4, 3)), 0)
    lenses = [Camera((640, 480), -0.25), Camera((640, 480))]
    for wrong, says in (
        (lambda: align(cameras, [link, link]), "same images"),
        (lambda: align(cameras[:1], [link]), "outside of the 1"),
        (lambda: align(lenses, [link], AlignmentOptions(lens_known=True)), "lenses that differ"),
        (lambda: AlignmentOptions(model=cast(Any, "affine")), "model must be"),
        (lambda: AlignmentOptions(lens=cast(Any, "brown")), "lens must be one of .*division-center"),
        (lambda: AlignmentOptions(max_matches_per_link=4), "at least 5"),
        (lambda: replace(link, image2=0), "with itself"),
        (lambda: replace(link, points1=link.points1 * np.nan), "not finite"),
        (lambda: replace(link, relation=failed), "failed fit"),
    ):
        with pytest.raises(ArgumentError, match=says):
            wrong()
    few = replace(link, points1=link.points1[:4], points2=link.points2[:4])
    for nothing in ([], [few]):
        with pytest.raises(RegistrationError, match="no two images overlap"):
            align(cameras, nothing)


def _matched(points1: FloatArray, points2: FloatArray) -> Link:
    camera = Camera((800, 600)).with_focal(600.0)
    return Link(0, 1, points1, points2, RadialHomography(np.eye(3), camera, camera, np.ones(len(points1), np.bool_)))


@pytest.mark.parametrize("model", ["auto", "homography"])
@pytest.mark.parametrize("count", [20, 60])
def test_matches_at_random_are_no_alignment(model: ModelName, count: int) -> None:
    points = np.random.default_rng(0).uniform((0.0, 0.0), (799.0, 599.0), (2, count, 2))
    link = _matched(*points)
    with pytest.raises(RegistrationError, match="no motion explains"):
        align([link.relation.camera] * 2, [link], AlignmentOptions(model=model))


def test_one_place_that_is_matched_many_times_links_nothing() -> None:
    link = _matched(np.tile([10.0, 20.0], (30, 1)), np.tile([15.0, 25.0], (30, 1)))
    with pytest.raises(RegistrationError, match="no two images overlap"):
        align([link.relation.camera] * 2, [link])


def test_exact_attitudes_are_checked_like_the_others() -> None:
    with pytest.raises(ArgumentError, match="attitudes must have the shape"):
        AlignmentOptions(tilt=(0.0, 0.0), attitudes=np.zeros(2)).exact_tilts(3)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"gravity": "up"}, "gravity must be an array of numbers"),
        ({"attitudes_std": math.nan}, "attitudes_std"),
        ({"tilt": (0.1, 0.2, 0.3)}, "tilt must be"),
        ({"tilt": (math.inf, 0.0)}, "tilt must be finite"),
        ({"delayed_attitudes": np.zeros((2, 3, 2)), "attitudes": np.zeros((2, 2))}, "delayed_attitudes must have"),
        ({"delayed_attitudes": np.full((2, 61, 2), np.nan), "attitudes": np.zeros((2, 2))}, "finite angles"),
        ({"positions": np.full((2, 2), np.inf)}, "positions must be finite"),
        ({"attitudes": np.full((2, 2), np.nan)}, "finite angles"),
        ({"positions": np.zeros((2, 2)), "positions_std": np.zeros(2)}, "must be positive"),
        ({"positions": np.zeros((2, 2)), "positions_std": np.ones(1)}, "positions_std must have the shape"),
        ({"gravity": np.zeros((1, 3))}, "gravity must have the shape"),
        ({"control": (Sighting(99, (0.0, 0.0), "P1", (0.0, 0.0)),)}, "P1 is in image 99"),
        ({"control": (Sighting(-1, (0.0, 0.0), "P1", (0.0, 0.0)),)}, "P1 is in image -1"),
        ({"control": (Sighting(0, (math.nan, 0.0), "P1", (0.0, 0.0)),)}, "P1: place, offset"),
        ({"control": tuple(Sighting(k, (0.0, 0.0), "P1", (3.0 * k, 0.0), 2.0) for k in (0, 1))}, "places, 3 m apart"),
    ],
)
def test_what_cannot_be_of_the_images_is_refused(options: dict[str, object], named: str) -> None:
    with pytest.raises(ArgumentError, match=named):
        aligned(grid_scene(2, 1, seed=15), **options)


def test_a_named_reference_in_another_group_is_missed_aloud() -> None:
    given = grid_scene(7, 1, yaw=0.1, seed=9)
    split = [link for link in given.links if (link.image1 < 5) == (link.image2 < 5)]
    for reference, missed in ((6, True), (2, False)):
        found = align(given.cameras, split, AlignmentOptions(reference=reference, lens="division"))
        assert (found.reference == reference) is not missed
        assert any("reference image" in message.text for message in found.messages) is missed


def test_errors_that_neighbours_share_weigh_the_same_with_and_without_a_wrong_pair() -> None:
    rng = np.random.default_rng(4)
    given = scene(robot_path(10, 0.15), reach=3, rng=rng)
    task = AlignmentTask(given.cameras, given.links, AlignmentOptions(model="rigid", lens="division"))
    links = [*given.links, _wrong_link(given, 0, 9, rng)]
    with_wrong = replace(task, links=links)
    selected, without = with_wrong._selected, task._selected
    assert without.problem.overdispersion > 1.2
    assert selected.kept_links.tolist() == [*[True] * len(given.links), False]
    assert selected.problem.overdispersion == pytest.approx(without.problem.overdispersion, rel=0.3)
    assert selected.choice.fit.overdispersion >= selected.problem.overdispersion


def test_attitudes_known_exactly_determine_no_less_than_almost_exact_ones() -> None:
    given = grid_scene(4, 3, wind=(0.1, 0.05), seed=12, tilt=(0.03, 0.02), per_link=80)
    attitudes = given.poses[:, [PSI, THETA]]
    std = [
        aligned(given, model="tilting", lens="division", attitudes=attitudes, attitudes_std=scatter).distortion_std
        for scatter in (0.0, 1e-6, 1e-4, 1e-2)
    ]
    assert std[0] == pytest.approx(std[1], rel=1e-3)
    assert (np.diff(std) > -1e-3 * std[0]).all()


def test_an_image_that_contradicts_the_others_names_them() -> None:
    found = aligned(grid_scene(2, 1, seed=11))
    contradicting = replace(found.links[0], image1=0, image2=2, reason=Unused.CONTRADICTS)
    whole = replace(
        found, used=np.array([True, True, False]), components=((0, 1), (2,)), links=(*found.links, contradicting)
    )
    (message,) = explain_unaligned(whole, ["left.png", "middle.png", "right.png"], [900] * 3, {})
    assert message.images == ("right.png",)
    assert "its overlap with left.png contradicts" in message.text


def test_small_tilts_do_not_ask_for_a_short_focal_length() -> None:
    """Images show tilts divided by the focal length, and hardly show that itself over rough ground."""
    wind = 0.05, math.radians(1.5)
    given = grid_scene(
        12, 1, (0.35, 0.1), 0.1, seed=3, noise=0.5, per_link=60, relief=0.02, reach=2, focal_source=None, wind=wind
    )
    found = aligned(given, model="tilting", lens="division")
    assert abs(math.log(found.focal * given.cameras[0].scale / 520.0)) < 0.3


def test_matches_off_by_less_than_a_lens_is_exact_agree() -> None:
    """Where most links are of crossings that are exact to 0.03 px, 0.2 px are no contradiction; 2 px are one."""
    rng = np.random.default_rng(5)
    given = scene(grid(4, 3, (0.35, 0.3), 0.2, rng), noise=0.03, outliers=0.0, rng=rng)
    for size, agrees in ((0.2, True), (2.0, False)):
        first = given.links[0]
        angle = rng.uniform(0.0, 2.0 * np.pi, len(first.points2))
        off = first.points2 + size * np.column_stack([np.cos(angle), np.sin(angle)])
        links = [replace(first, points2=off), *given.links[1:]]
        fit = aligned(replace(given, links=links)).links[0]
        assert fit.used
        assert (fit.inliers > 0.9 * fit.count) == agrees
