"""Whether images agree where they overlap."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.alignment.motion_models.rotation import rotation_from_vector
from rdstitch.alignment.result import LinkFit
from rdstitch.geometry.camera import Camera
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage
from rdstitch.synthetic.textures import ground
from rdstitch.verification import overlap_check
from rdstitch.verification.overlap_check import CheckedLink, _least_confirmed, wrong_at_most
from rdstitch.verification.photometric_agreement import COMPARED_SIDE, Agreement, ComparedImage, overlap_agreement
from rdstitch.verification.self_similarity import Ambiguity

PLANE = ground((900, 700), seed=3, channels=1).region(0, 0, 900, 700)[:, :, 0]
SIZE = (400, 300)
LENS = Camera(SIZE)


def _placed(
    left: int, top: int, *, put: tuple[float, float] = (0.0, 0.0), pixels: np.ndarray | None = None
) -> ComparedImage:
    """A window of the plane; ``put`` so many pixels beside its place."""
    seen = PLANE[top : top + SIZE[1], left : left + SIZE[0]] if pixels is None else pixels
    matrix = np.eye(3)
    matrix[:2, 2] = (np.array([left, top]) + put) / LENS.scale
    return ComparedImage(np.ascontiguousarray(seen, dtype=np.float32), LENS, matrix)


def _fraction(agreement: Agreement) -> float:
    assert agreement.confirming_fraction is not None
    return agreement.confirming_fraction


@pytest.mark.parametrize(("off", "agree"), [(2.0, True), (3.4, False), (12.0, False)])
def test_two_and_a_half_pixels_are_forgiven(off: float, agree: bool) -> None:
    for put in ((off, 0.0), (0.0, -off), (-off * 0.6, off * 0.8)):
        found = overlap_agreement(_placed(100, 100), _placed(200, 150, put=put))
        assert (_fraction(found) > 0.8) if agree else (_fraction(found) < 0.2), put


def test_the_same_ground_agrees_whatever_its_exposure_and_contrast_and_other_ground_does_not() -> None:
    window = PLANE[150:450, 200:600]
    for pixels in (window, 0.1 + 0.4 * window):
        found = overlap_agreement(_placed(100, 100), _placed(200, 150, pixels=pixels))
        assert found.cells > 40
        assert _fraction(found) == found.confirming / found.cells > 0.95
    assert _fraction(overlap_agreement(_placed(0, 0), _placed(0, 0, pixels=PLANE[390:690, 400:800]))) < 0.15


def test_small_differences_on_a_large_base_count() -> None:
    """As of thermal cameras: 16-bit counts, or kelvins."""
    for base, scale, kind in ((12000.0, 31.0, np.uint16), (290.0, 0.6, np.float32)):
        compared = []
        for placed in (_placed(100, 100), _placed(200, 150)):
            image = DecodedImage((base + scale * placed.grey).astype(kind), None, Metadata(SIZE))
            compared.append(ComparedImage.of(image, LENS, placed.homography, (base, base + scale)))
        found = overlap_agreement(*compared)
        assert found.cells > 40
        assert _fraction(found) > 0.95


def test_what_has_no_texture_says_nothing() -> None:
    flat = np.full((300, 400), 0.5, dtype=np.float32)
    assert overlap_agreement(_placed(100, 100, pixels=flat), _placed(200, 150)).cells == 0
    assert overlap_agreement(_placed(100, 100), _placed(200, 150, pixels=flat)).cells == 0
    assert Agreement(7, 7).confirming_fraction is None
    # Noise of a hundredth of full range is none; of a fiftieth it is.
    noise = np.random.default_rng(0).normal(0.5, 1.0, (300, 400))
    for size, textured in ((0.009, False), (0.02, True)):
        made = (0.5 + size * (noise - 0.5)).astype(np.float32)
        assert (overlap_agreement(_placed(0, 0, pixels=made), _placed(0, 0, pixels=made)).cells > 0) is textured


def test_cells_lie_inside_the_overlap() -> None:
    whole = overlap_agreement(_placed(100, 100), _placed(100, 100))
    # Cells of 24 pixels, with eight around them: 15 by 11.
    assert 120 < whole.cells <= whole.textured_cells <= 16 * 12
    none = overlap_agreement(_placed(0, 0), _placed(500, 400))
    assert none.cells == 0
    half = overlap_agreement(_placed(100, 100), _placed(300, 100))
    assert 0.3 * 165 < half.cells < 0.55 * 165
    masked = PLANE[100:400, 100:500].copy()
    masked[:, 200:] = np.nan
    seen = overlap_agreement(_placed(100, 100, pixels=masked), _placed(100, 100))
    assert 0.3 * 165 < seen.cells < 0.55 * 165
    assert _fraction(seen) > 0.95


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_images_are_compared_small_and_grey(dtype: type) -> None:
    full = np.iinfo(dtype).max
    pixels: NDArray[Any] = np.zeros((600, 2 * COMPARED_SIDE, 3), dtype=dtype)
    pixels[..., 0] = full
    alpha = np.full((600, 2 * COMPARED_SIDE), 255, np.uint8)
    alpha[:, :512] = 0
    made = ComparedImage.of(DecodedImage(pixels, alpha, Metadata((1024, 600))), Camera((1024, 600)), np.eye(3))
    assert made.grey.shape == (300, COMPARED_SIDE)
    assert made.camera.image_size == (COMPARED_SIDE, 300)
    assert np.isnan(made.grey[:, :250]).all()
    np.testing.assert_allclose(made.grey[:, 260:], 1.0 / 3.0, rtol=1e-5)
    small = ComparedImage.of(
        DecodedImage(pixels[:100, :200], None, Metadata((200, 100))), Camera((200, 100)), np.eye(3)
    )
    assert small.grey.shape == (100, 200)
    dark = DecodedImage(pixels[:100, :200, 0] // 10, None, Metadata((200, 100)))
    low = ComparedImage.of(dark, LENS, np.eye(3), (0.0, full / 5))
    np.testing.assert_allclose(low.grey, 0.5, rtol=0.02)


def test_images_of_many_bands_are_compared() -> None:
    """More than the four channels that OpenCV makes smaller by a share."""
    bands = np.arange(10, 15, dtype=np.uint8) * np.ones((600, 900, 1), np.uint8)
    made = ComparedImage.of(DecodedImage(bands, None, Metadata((900, 600))), Camera((900, 600)), np.eye(3))
    np.testing.assert_allclose(made.grey, 12.0 / 255.0, rtol=1e-5)


def _fit(i: int, j: int, inliers: int = 50) -> LinkFit:
    return LinkFit(i, j, 100, inliers, 0.5)


def test_a_place_that_a_float_image_does_not_know_spoils_no_other() -> None:
    pixels = PLANE[:300, :400].astype(np.float32)
    pixels[10, 20] = np.nan
    grey = ComparedImage.of(DecodedImage(pixels, None, Metadata(SIZE)), LENS, np.eye(3)).grey
    assert np.isfinite(grey).mean() > 0.99


def test_of_many_links_those_with_the_fewest_triangles_and_matches_are_compared() -> None:
    """A clique of nine has 36 links in seven triangles each; a chain of 20 hangs on it. Of few all are compared."""
    links = [_fit(i, i + 1) for i in range(40)]
    assert _least_confirmed(links) == {fit.images for fit in links}
    clique = [_fit(i, j) for i in range(9) for j in range(i + 1, 9)]
    chain = [_fit(k, k + 1, 30 + k) for k in range(8, 28)]
    chosen = _least_confirmed([*clique, *chain])
    assert len(chosen) == 40
    assert {fit.images for fit in chain} <= chosen
    weak = [_fit(fit.image1, fit.image2, 10 if fit.image1 == 3 else 50) for fit in clique]
    chosen = _least_confirmed([*weak, *chain])
    assert {fit.images for fit in weak if fit.inliers == 10} <= chosen


def test_of_very_many_some_are_compared_at_random_wherever_they_lie() -> None:
    links = [_fit(k, k + 1) for k in range(8000)]
    chosen = overlap_check._at_random(links)
    assert chosen == overlap_check._at_random(links)
    assert len(chosen) == 300
    quarters = np.bincount([image // 2000 for image, _ in chosen], minlength=4)
    assert quarters.min() > 50
    sampled = [CheckedLink(fit, Agreement(20, 20), Ambiguity(1.0, 0.0, 0.0), sampled=True) for fit in links[:300]]
    assert 0.008 < wrong_at_most(sampled) < 0.01
    wrong = [replace(link, agreement=Agreement(20, 0)) for link in sampled[:6]]
    assert 0.03 < wrong_at_most([*wrong, *sampled[6:]]) < 0.05
    assert wrong_at_most([replace(link, sampled=False) for link in sampled]) == 1.0


def test_a_turn_is_compared_between_the_two_images() -> None:
    """Halfway between two directions, each image is tilted by half the angle."""
    first, last, half = (rotation_from_vector(np.array([[0.0, angle, 0.0]]))[0] for angle in (0.1, 0.4, 0.15))
    focal = np.diag([0.7, 0.7, 1.0])  # half diagonals to directions
    grey = np.zeros((2, 2), np.float32)
    both = overlap_check._between(*(ComparedImage(grey, Camera((64, 48)), turn @ focal) for turn in (first, last)))
    np.testing.assert_allclose(both[0].homography, half.T @ focal, atol=1e-9)
    np.testing.assert_allclose(both[1].homography, half @ focal, atol=1e-9)
