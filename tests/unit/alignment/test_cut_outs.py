"""Crops and scans of unequal size have one lens in pixels; smaller copies have one in half diagonals."""

from dataclasses import replace

import numpy as np
import pytest

from examples.worlds.alignment_scenes import Scene, grid_scene
from rdstitch.alignment import AlignmentOptions, align
from rdstitch.alignment.frames.cut_outs import common_size, cut_alignment, framed_camera, framed_link
from rdstitch.geometry.camera import Camera
from rdstitch.matching.links import Link


def _cut(given: Scene, margins: list[tuple[int, int]]) -> tuple[list[Camera], list[Link]]:
    """The images without so many columns and rows on each side."""
    sizes = [(640 - 2 * x, 480 - 2 * y) for x, y in margins]
    cameras = [Camera(size, focal=520.0, focal_source="option") for size in sizes]
    links = []
    for link in given.links:
        points = [link.points1 - margins[link.image1], link.points2 - margins[link.image2]]
        ends = [cameras[link.image1], cameras[link.image2]]
        inside = np.all(
            [(p > 0) & (p < np.array(c.image_size) - 1.0) for p, c in zip(points, ends, strict=True)], (0, 2)
        )
        ratios = [c.scale / given.cameras[0].scale for c in ends]
        first, second = (np.array([ratio, ratio, 1.0]) for ratio in ratios)
        lens = [c.with_coefficients(given.distortion * r**2) for c, r in zip(ends, ratios, strict=True)]
        relation = replace(
            link.relation,
            homography=link.relation.homography * first / second[:, None],
            camera=lens[0],
            camera2=lens[1],
            inliers=inside[inside],
        )
        links.append(replace(link, points1=points[0][inside], points2=points[1][inside], relation=relation))
    return cameras, links


def test_cut_images_are_aligned_with_one_lens_in_pixels() -> None:
    given = grid_scene(3, 2, (0.3, 0.25), 0.1, seed=3, noise=0.1, outliers=0.0)
    cameras, links = _cut(given, [(0, 0), (40, 10), (0, 30), (60, 0), (20, 20), (0, 0)])
    size = common_size(cameras, links)
    assert size == (640, 480)
    framed = align(
        [framed_camera(c, size) for c in cameras],
        [framed_link(k, size) for k in links],
        AlignmentOptions(model="rigid"),
    )
    found = cut_alignment(framed, [c.image_size for c in cameras])
    for k, camera in enumerate(found.cameras):
        assert camera.focal == pytest.approx(520.0, rel=0.02)
        assert camera.distortion_px == pytest.approx(given.distortion / 400.0**2, rel=0.03)
        for other in range(len(cameras)):
            corner = np.array([[30.0, 40.0]])
            moved = framed.transfer(
                k, other, corner + (640 - camera.image_size[0], 480 - camera.image_size[1]) / np.array(2)
            )
            margin = np.array([640, 480]) - cameras[other].image_size
            np.testing.assert_allclose(found.transfer(k, other, corner), moved - margin / 2.0, atol=1e-6)


def test_smaller_copies_and_images_of_one_size_are_no_cut_outs() -> None:
    given = grid_scene(2, 2, (0.3, 0.25), 0.1, seed=4)
    assert common_size(given.cameras, given.links) is None
    small = Camera((320, 240))
    cameras = [small, *given.cameras[1:]]
    links = [
        replace(k, points1=(k.points1 - 0.5) / 2.0, relation=replace(k.relation, camera=small)) if k.image1 == 0 else k
        for k in given.links
    ]
    assert common_size(cameras, links) is None


def test_a_pair_s_wild_estimate_of_a_crop_does_not_end_the_alignment() -> None:
    """λ of a pair alone may be off; in the larger frame it would fold the corners, where the pair has no match."""
    given = grid_scene(2, 2, (0.3, 0.25), 0.1, seed=4)
    link = given.links[0]
    wild = replace(link, relation=replace(link.relation, camera=link.relation.camera.with_coefficients(0.48)))
    framed = framed_link(wild, (1280, 960))
    assert framed.relation.distortion < 1.0
    np.testing.assert_allclose(framed.points1, link.points1 + np.array([320.0, 240.0]))
