"""Projections, the part of the ground that is near enough, and views that are turned upright."""

import math
from dataclasses import replace

import numpy as np
import pytest

from examples.worlds.compositing_scenes import as_image, gradient, grey, loader, place_images
from examples.worlds.turns import TurningSequence, camera_rotations, turning_sequence
from rdstitch.alignment.frames.reference_view import view_rotation
from rdstitch.arrays import FloatArray
from rdstitch.choices import ProjectionName
from rdstitch.compositing import Canvas, Composite, CompositeOptions, compose, plan_panorama
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.canvas import plan_canvas
from rdstitch.compositing.compositor import photo_sphere_xmp
from rdstitch.compositing.panorama_canvas import center_of_view, choose_projection, field_of_view, seen_directions
from rdstitch.compositing.projection import PLANE, PROJECTIONS
from rdstitch.compositing.visible_region import VisibleRegion, visible_regions
from rdstitch.compositing.warp import plan_warp
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage
from rdstitch.synthetic.rendering import Photometry

LENS = Camera((160, 120), -0.2, focal=110.0, focal_source="option")


def _directions(rotations: np.ndarray) -> np.ndarray:
    """What the alignment gives: from undistorted coordinates, in half diagonals, to directions."""
    return np.swapaxes(rotations, 1, 2) @ np.diag([1.0, 1.0, LENS.focal / LENS.scale])


def _panorama(rotations: np.ndarray, gains: float = 0.0) -> tuple[TurningSequence, np.ndarray]:
    gain = np.exp(np.random.default_rng(1).normal(0.0, gains, len(rotations)))
    return turning_sequence(LENS, rotations, seed=4, photometry=Photometry(gain=gain)), _directions(rotations)


def _composed(
    sequence: TurningSequence, directions: np.ndarray, canvas: Canvas, options: CompositeOptions
) -> Composite:
    frames = sequence.frames()
    return compose(
        place_images([loader(as_image(frame)) for frame in frames], [LENS] * len(frames), directions), canvas, options
    )


@pytest.mark.parametrize("name", PROJECTIONS)
def test_directions_come_back(name: ProjectionName) -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200, 3))
    directions[:, 2] = np.abs(directions[:, 2]) if name == "plane" else directions[:, 2]
    places = PROJECTIONS[name].project(directions)
    back = np.stack(np.broadcast_arrays(*PROJECTIONS[name].directions(*places.T)), axis=-1)
    np.testing.assert_allclose(
        back / np.linalg.norm(back, axis=1, keepdims=True),
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        atol=1e-9,
    )


def test_the_projection_follows_the_view() -> None:
    lens = [LENS]
    narrow = seen_directions(lens, _directions(camera_rotations(0.0)))
    assert choose_projection(narrow) == PLANE
    wide = seen_directions(lens * 4, _directions(camera_rotations(np.radians([-60, -20, 20, 60]))))
    assert choose_projection(wide).name == "cylinder"
    high = seen_directions(lens * 2, _directions(camera_rotations([0.0, 0.0], np.radians([30.0, -30.0]))))
    assert choose_projection(high).name == "sphere"
    around = seen_directions(lens * 9, _directions(camera_rotations(np.arange(9) * 2 * np.pi / 9)))
    assert around.around
    assert choose_projection(around).name == "sphere"


@pytest.mark.parametrize("heading", [0.0, 2.0, np.pi])
def test_the_edge_lies_where_nothing_is_shown(heading: float) -> None:
    headings = heading + np.radians([-100, -50, 0, 50, 100])
    view = seen_directions([LENS] * 5, _directions(camera_rotations(headings)))
    assert not view.around
    width, _ = view.extent
    assert width < np.radians(290)
    canvas = plan_panorama([LENS] * 5, _directions(camera_rotations(headings)), projection="sphere")
    for box in map(canvas.box, range(len(canvas.footprints))):
        assert box[2] - box[0] < 0.3 * canvas.size[0]


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5, np.pi])
def test_a_gap_that_is_open_between_closed_corners_lies_at_the_border(heading: float) -> None:
    """A turn of 358 degrees: the barrel-shaped images meet at their corners, and not between."""
    side = LENS.undistort(np.array([[-0.5, 59.5]]))[0, 0] - 79.5
    half = np.arctan2(-side, 110.0)
    headings = heading + np.linspace(half, np.radians(358.0) - half, 9)
    rotations = camera_rotations(headings)
    sequence, directions = _panorama(rotations)
    canvas = plan_panorama([LENS] * 9, directions)
    assert canvas.period == canvas.size[0]
    found = _composed(sequence, directions, canvas, CompositeOptions())
    middle = found.alpha[found.alpha.shape[0] // 2] > 0
    width = canvas.size[0]
    assert not middle.all()
    assert middle[width // 100 : -width // 100].all()
    assert not middle[0]
    assert not middle[-1]


@pytest.mark.parametrize("name", [name for name in PROJECTIONS if name != "plane"])
@pytest.mark.parametrize("rotate", [0.0, 15.0])
def test_points_of_an_image_come_back_through_the_warp(name: ProjectionName, rotate: float) -> None:
    rotations = camera_rotations([0.4, -0.5], [0.2, -0.1], [0.1, 0.2])
    directions = _directions(rotations)
    canvas = plan_panorama([LENS] * 2, directions, projection=name, rotate=rotate)
    px = np.random.default_rng(0).uniform((0, 0), (159, 119), (50, 2))
    for index in range(2):
        places = canvas.place(LENS, directions[index], px)
        assert ((places > -0.6) & (places < np.array(canvas.size) - 0.4)).all()
        warp = plan_warp(LENS, directions[index], canvas, index)
        np.testing.assert_allclose(warp.source_points(places[:, 0], places[:, 1]), px, atol=1e-6)
        assert warp.shrink == pytest.approx(1.0, rel=0.3)


def test_what_a_projection_cannot_show_is_refused_by_name() -> None:
    behind = _directions(camera_rotations([0.0, 3.0]))
    for name in ("panini", "stereographic"):
        with pytest.raises(LimitError, match=r"b.png.*--projection sphere"):
            plan_panorama([LENS] * 2, behind, projection=name, names=["a.png", "b.png"], max_stretch=3.0)
    around = _directions(camera_rotations(np.arange(9) * 2 * np.pi / 9))
    with pytest.raises(ArgumentError, match="rotate"):
        plan_panorama([LENS] * 9, around, rotate=10.0)
    with pytest.raises(LimitError):
        plan_panorama([LENS] * 9, around, projection="plane")


@pytest.mark.parametrize("name", ["plane", "cylinder", "mercator"])
def test_nothing_is_stretched_beyond_the_limit(name: ProjectionName) -> None:
    rotations = camera_rotations([-0.6, -0.2, 0.2, 0.6], [0.0, 0.6, 0.6, 0.0], 0.05)
    directions = _directions(rotations)
    free = plan_panorama([LENS] * 4, directions, projection=name, reference=0)
    near = plan_panorama([LENS] * 4, directions, projection=name, reference=0, max_stretch=1.5)
    assert near.size[1] < 0.8 * free.size[1]
    if name != "plane":
        x, y = np.zeros(1), np.array([(-0.5 - near.matrix[1, 2]) / near.matrix[0, 0]])
        top = np.array([float(part[0]) for part in np.broadcast_arrays(*near.projection.directions(x, y))])
        cosine = np.hypot(top[0], top[2]) / np.linalg.norm(top)
        assert cosine ** -(1 if name == "mercator" else 2) == pytest.approx(1.5, rel=0.01)


def test_an_image_that_is_stretched_everywhere_is_refused_by_name() -> None:
    up = _directions(camera_rotations([0.0, 0.5], [0.0, 1.2]))
    with pytest.raises(LimitError, match=r"b.png.*--projection sphere, or raise --max-stretch"):
        plan_panorama([LENS] * 2, up, projection="cylinder", names=["a.png", "b.png"], max_stretch=1.2)


# "balanced" keeps regions near the brightness of their own images, and so depends on which of them the extension of
# the canvas shows twice; what it may not do is to leave a step at the edge.
OPTIONS = {
    "balanced": CompositeOptions(),
    "multiband": CompositeOptions(exposure="gain"),
    "feather": CompositeOptions(blend="feather", seam="voronoi", exposure="gain"),
    "no seam": CompositeOptions(seam="none", exposure="none"),
    "small tiles": CompositeOptions(tile_size=256, workers=2, exposure="gain"),
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_a_full_turn_is_joined_without_a_seam(options: CompositeOptions) -> None:
    """The step across the edge is no larger than any other step between neighbouring columns."""
    rotations = camera_rotations(0.3 + np.arange(9) * 2 * np.pi / 9)
    sequence, directions = _panorama(rotations, gains=0.2)
    canvas = plan_panorama([LENS] * 9, directions)
    assert canvas.period == canvas.size[0]
    assert canvas.period % 32 == 0
    found = _composed(sequence, directions, canvas, options)
    assert found.canvas.size == canvas.size
    values = grey(found.pixels)
    rows = (found.alpha > 0).all(axis=1)
    steps = np.abs(values[rows] - np.roll(values[rows], 1, axis=1)).mean(axis=0)
    assert steps[0] < np.quantile(steps, 0.99)
    if options.exposure == "balanced":
        return
    # Shown from another heading, the same sphere is the same image, moved.
    turn = 2 * np.pi * 96 / canvas.size[0]
    turned = _directions(rotations @ camera_rotations(turn)[0].T)
    moved = _composed(sequence, turned, plan_panorama([LENS] * 9, turned), options)
    back = np.roll(grey(moved.pixels), 96, axis=1)
    differences = np.abs(back - values)[rows]
    assert np.median(differences) < 0.005
    assert np.mean(differences > 0.05) < 0.01


def test_poles_are_shown_whole() -> None:
    rotations = camera_rotations([*(np.arange(8) * np.pi / 4), 0.0], [*[0.9] * 8, np.pi / 2])
    sequence, directions = _panorama(rotations)
    canvas = plan_panorama([LENS] * 9, directions)
    assert canvas.box(8)[0] == 0
    assert canvas.box(8)[2] == canvas.size[0]
    found = _composed(sequence, directions, canvas, CompositeOptions())
    assert (found.alpha[: canvas.size[1] // 3] > 0).all()


def test_a_small_planet_is_shown_whole() -> None:
    """The sphere looked at from above: what is straight down in the middle, the zenith beyond the edge."""
    pitches = [*[0.5] * 8, *[-0.5] * 8, -np.pi / 2, np.pi / 2]
    rotations = camera_rotations([*(np.arange(16) * np.pi / 4), 0.0, 0.0], pitches)
    sequence, directions = _panorama(rotations)
    down = camera_rotations(0.0, -np.pi / 2)[0]
    canvas = plan_panorama([LENS] * 18, down @ directions, projection="stereographic", max_stretch=16.0)
    assert canvas.box(17) == (0, 0, *canvas.size)
    found = _composed(sequence, down @ directions, canvas, CompositeOptions(seam="voronoi", exposure="none"))
    assert canvas.size == pytest.approx((4 * np.sqrt(15) * 110,) * 2, abs=1)
    assert (found.alpha > 0).mean() > 0.995
    assert field_of_view(canvas)[0] == pytest.approx(4 * np.arctan(np.sqrt(15)), abs=0.01)
    assert center_of_view(canvas) == pytest.approx((0.0, 0.0), abs=0.01)


def test_cropping_a_full_turn_keeps_its_width() -> None:
    sequence, directions = _panorama(camera_rotations(np.arange(9) * 2 * np.pi / 9, 0.0, [0.05, -0.05, 0.0] * 3))
    canvas = plan_panorama([LENS] * 9, directions)
    found = _composed(sequence, directions, canvas, CompositeOptions(crop="auto"))
    assert found.canvas.size[0] == canvas.size[0]
    assert found.canvas.size[1] < canvas.size[1]
    assert (found.alpha > 0).all()
    assert gradient(grey(found.pixels)).mean() > 0.0


def test_viewers_are_told_which_part_of_the_sphere_it_is() -> None:
    rotations = camera_rotations(np.arange(9) * 2 * np.pi / 9, 0.2)
    canvas = plan_panorama([LENS] * 9, _directions(rotations))
    width, height = canvas.size
    text = photo_sphere_xmp(canvas).decode()
    assert f'GPano:FullPanoWidthPixels="{width}"' in text
    assert f'GPano:FullPanoHeightPixels="{width // 2}"' in text
    assert f'GPano:CroppedAreaImageHeightPixels="{height}"' in text
    low, high = seen_directions([LENS] * 9, _directions(rotations)).bounds
    top = (np.pi / 2 + low[1]) * width / (2 * np.pi)
    assert f'GPano:CroppedAreaTopPixels="{round(top)}"' in text
    across, down = field_of_view(canvas)
    assert across == pytest.approx(2 * np.pi)
    assert down == pytest.approx(high[1] - low[1], abs=2 / 110)
    assert center_of_view(canvas)[1] == pytest.approx((low[1] + high[1]) / 2, abs=1 / 110)
    assert photo_sphere_xmp(plan_panorama([LENS] * 9, _directions(rotations), projection="cylinder")) == b""


@pytest.mark.parametrize(
    ("box", "left"), [((0, 500, 4096, 1500), 0), ((1000, 500, 2000, 1500), 1000), ((3500, 500, 4500, 1500), 3096)]
)
def test_viewers_are_told_where_a_part_of_a_full_turn_is(box: Box, left: int) -> None:
    """A part across the edge, which they cannot show, is beside it."""
    whole = plan_panorama([LENS] * 9, _directions(camera_rotations(np.arange(9) * 2 * np.pi / 9)))
    resolution = 4096 / (2 * np.pi)
    matrix = np.array([[resolution, 0.0, 2047.5], [0.0, resolution, 1023.5], [0.0, 0.0, 1.0]])
    canvas = replace(whole, size=(4096, 2048), matrix=matrix, period=4096.0).cropped(box)
    text = photo_sphere_xmp(canvas).decode()
    assert 'GPano:FullPanoWidthPixels="4096"' in text
    assert f'GPano:CroppedAreaLeftPixels="{left}"' in text
    assert 'GPano:CroppedAreaTopPixels="500"' in text


def test_an_image_that_a_crop_of_a_full_turn_leaves_out_has_one_pixel() -> None:
    canvas = plan_panorama([LENS] * 9, _directions(camera_rotations(np.arange(9) * 2 * np.pi / 9)))
    middle = canvas.footprints[4].mean(axis=0)[0] % canvas.size[0]
    far = round((middle + canvas.size[0] / 2) % canvas.size[0])
    x0, y0, x1, _ = canvas.cropped((far, 0, far + 20, canvas.size[1])).box(4)
    assert x1 - x0 == 1
    assert y0 == 0


NEAR = Camera((400, 300), distortion=-0.2, focal=300.0)
FOCAL = 300.0 / NEAR.scale


def _image_to_plane(tilt: float) -> FloatArray:
    """Of a camera at height one that looks down, tilted about its x axis, radians."""
    return np.asarray(np.linalg.inv(np.diag([FOCAL, FOCAL, 1.0]) @ rotation_from_tilt((tilt, 0.0))), dtype=np.float64)


def _near(tilt: float, max_stretch: float = 3.0) -> VisibleRegion | None:
    resolution = FOCAL * NEAR.scale  # of the image straight from above
    return visible_regions([NEAR], [_image_to_plane(tilt)], resolution, max_stretch)[0]


@pytest.mark.parametrize("tilt", [0.9, 1.2])
def test_nothing_is_drawn_beyond_the_stretch(tilt: float) -> None:
    assert _near(0.0) is None
    near = _near(tilt)
    outline = near.outline()
    plane = to_plane(NEAR, _image_to_plane(tilt), outline)
    assert np.isfinite(plane).all()
    inside = (np.abs(outline - (199.5, 149.5)) <= (200.1, 150.1)).all(axis=1)
    assert inside.all()
    # Along the line of sight, a pixel of the image at most three times as long as that of one from above.
    steps = np.stack([to_plane(NEAR, _image_to_plane(tilt), outline + np.array([0.0, s])) for s in (-0.05, 0.05)])
    along = np.linalg.norm(steps[1] - steps[0], axis=1) / 0.1 * FOCAL * NEAR.scale
    finest = float(along.min())
    assert along.max() < 3.0 * max(finest, 1.0) * 1.6  # a little more where the lens itself stretches
    assert along.max() > 2.0


def test_the_mask_is_what_the_outline_encloses() -> None:
    near = _near(1.2)
    whole = DecodedImage(np.full((300, 400), 200, np.uint8), None, Metadata((400, 300)))
    drawn = near.masked(whole).alpha
    x, y = near.outline().T
    area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    assert (drawn > 0).sum() == pytest.approx(area, rel=0.01)
    half = near.masked(DecodedImage(np.full((150, 200), 200, np.uint8), None, Metadata((400, 300)))).alpha
    assert (half > 0).sum() * 4 == pytest.approx(area, rel=0.02)


@pytest.mark.parametrize("tilt", [0.3, 0.9])
def test_what_is_cut_away_is_what_the_mask_leaves_out(tilt: float) -> None:
    matrix, (width, height) = _image_to_plane(tilt), NEAR.image_size
    canvas = plan_canvas([NEAR], matrix[None], max_stretch=1.5)
    share, near = canvas.cut_away([NEAR], matrix[None]), canvas.near[0]
    empty = DecodedImage(np.zeros((height, width), np.uint8), None, Metadata(NEAR.image_size))
    shown = 1.0 if near is None else (near.masked(empty).alpha > 0).mean()
    assert share == pytest.approx(1.0 - shown, abs=0.02)
    assert (share > 0.1) == (tilt > 0.5)


def test_an_image_that_shows_the_horizon_does_not_blow_up_the_canvas() -> None:
    homographies = [_image_to_plane(0.0), _image_to_plane(math.radians(75.0))]
    with pytest.raises(LimitError, match="horizon"):
        plan_canvas([NEAR, NEAR], homographies, reference=0)
    canvas = plan_canvas([NEAR, NEAR], homographies, reference=0, max_stretch=3.0)
    assert canvas.near[0] is None
    assert canvas.near[1] is not None
    assert np.prod(canvas.size) < 20 * 400 * 300


def test_a_view_is_turned_right_up_and_clockwise() -> None:
    for name, seen in (("yaw", (0.5, 0.0)), ("pitch", (0.0, -0.5))):
        view = view_rotation(CompositeOptions(**{name: np.degrees(np.arctan(0.5))}))
        ahead = view @ (*seen, 1.0)
        np.testing.assert_allclose(ahead[:2], 0.0, atol=1e-12)
    rolled = view_rotation(CompositeOptions(roll=10.0))
    assert rolled @ (1.0, 0.0, 0.0) == pytest.approx((np.cos(np.radians(10)), -np.sin(np.radians(10)), 0.0))
    assert view_rotation(CompositeOptions()) is None
