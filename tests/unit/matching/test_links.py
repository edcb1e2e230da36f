"""Links in either direction."""

import itertools

import numpy as np

from rdstitch.camera import Camera
from rdstitch.matching.links import Link, in_alternate_directions
from rdstitch.radial_homography import RadialHomography


def _link(image1: int, image2: int) -> Link:
    first, second = Camera((640, 480), distortion=-0.2), Camera((320, 240), distortion=-0.2)
    relation = RadialHomography(
        np.array([[0.9, 0.1, 0.3], [-0.1, 1.1, 0.05], [0.02, 0.01, 1.0]]), first, second, np.ones(30, dtype=np.bool_)
    )
    points = np.random.default_rng(0).uniform((100.0, 100.0), (400.0, 380.0), (30, 2))
    return Link(image1, image2, points, relation.transfer(points), relation, 99)


def test_a_reversed_link_leads_back() -> None:
    link = _link(3, 5)
    back = link.reversed()
    assert (back.image1, back.image2, len(back)) == (5, 3, 99)
    np.testing.assert_allclose(back.relation.transfer(back.points1), back.points2, atol=1e-6)
    again = back.reversed()
    np.testing.assert_array_equal(again.points1, link.points1)
    np.testing.assert_allclose(again.relation.homography, link.relation.homography, atol=1e-12)
    assert again.relation.camera == link.relation.camera


def test_every_other_link_of_a_sequence_is_reversed_however_far_apart_its_images_are() -> None:
    for apart in (1, 2, 3, 7):
        given = [_link(k, k + apart) for k in range(12)]
        backward = [link.image1 > link.image2 for link in in_alternate_directions(given)]
        assert all(first is not second for first, second in itertools.pairwise(backward))
