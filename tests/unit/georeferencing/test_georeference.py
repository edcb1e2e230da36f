"""The place of a mosaic on the Earth, from made-up positions."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rasterio.warp
from PIL import ExifTags, Image

from rdstitch.arrays import FloatArray
from rdstitch.camera_files import camera_file_text
from rdstitch.compositing import CompositeOptions
from rdstitch.errors import ArgumentError, LimitError, OutputError
from rdstitch.export.poses_files import poses_file, poses_table
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.crs import Crs
from rdstitch.geometry.places import GpsPosition, GroundControl
from rdstitch.geometry.radial_homography import from_plane, to_plane
from rdstitch.georeferencing.camera_views import views_of
from rdstitch.georeferencing.georeference import Georeference, Residual, map_summary, world_file_paths
from rdstitch.georeferencing.map_grid import MapGrid
from rdstitch.georeferencing.place_on_map import AlignmentErrors, MapPlacement, place_on_map
from rdstitch.inputs.delays import MeasuredTilt
from rdstitch.inputs.named_system import NamedSystem
from rdstitch.io.strips import ImageSpec
from rdstitch.io.write import write_strips
from rdstitch.options.files_beside import FilesBeside
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.apply_sidecar import apply
from rdstitch.pipeline.composition.map_canvas import canvas_on_map
from rdstitch.pipeline.composition.output_messages import place_messages
from rdstitch.pipeline.recipes import mosaic
from rdstitch.report import report_page
from rdstitch.results.stitch_result import StitchResult
from rdstitch.robust.similarity_fit import fit_similarity
from rdstitch.synthetic.poses import Poses
from tests.cli.running import DISTORTION, flight, sidecar_of, transfers
from tests.registrations import CAMERA, registration, source, stitched


def _degrees(value: float) -> tuple[float, float, float]:
    minutes = abs(value) % 1 * 60
    return float(int(abs(value))), float(int(minutes)), minutes % 1 * 60


METRES_PER_TEXEL = 0.05


@pytest.fixture(scope="module")
def located(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], FloatArray]:
    """A flight, tilted by 3.3 degrees, with the positions of its cameras in EXIF; and where the middles of its images
    are on the ground: easting and northing, m.
    """
    sequence, folder = flight(4, 3, 2), tmp_path_factory.mktemp("located")
    middles = np.concatenate([sequence.to_plane(k, np.array([[199.5, 149.5]])) for k in range(len(sequence))])

    def on_map(places: FloatArray) -> FloatArray:
        return np.array([268_000.0, 6_346_000.0]) + places * (METRES_PER_TEXEL, -METRES_PER_TEXEL)

    latitude, longitude = Crs(32734).geographic(on_map(sequence.poses.position)).T
    paths = sequence.write(folder, "f{}.jpg")
    for path, phi, lam in zip(paths, latitude, longitude, strict=True):
        with Image.open(path) as image:
            exif = image.getexif()
            exif[ExifTags.IFD.GPSInfo] = {1: "S", 2: _degrees(phi), 3: "E", 4: _degrees(lam)}
            image.save(path, exif=exif, quality=95)
    return paths, on_map(middles)


@pytest.fixture(scope="module")
def cached(tmp_path_factory: pytest.TempPathFactory) -> StitchOptions:
    """The images are registered once for all tests."""
    return StitchOptions(workers=1, cache=tmp_path_factory.mktemp("cache"))


def _middles(output: Path) -> FloatArray:
    """Px of the output where the images' middles are, by the sidecar."""
    found = transfers(sidecar_of(output))
    return np.concatenate([found[k](np.array([[199.5, 149.5]])) for k in sorted(found)])


@pytest.mark.parametrize("crop", ["none", "auto"])
def test_a_tiff_lies_in_the_right_place_and_north_is_up(
    located: tuple[list[Path], FloatArray], cached: StitchOptions, tmp_path: Path, crop: Any
) -> None:
    paths, truth = located
    options = CompositeOptions(scale=0.7, crop=crop)
    result = mosaic(paths, tmp_path / "a.tif", replace(cached, composite=options))
    with rasterio.open(tmp_path / "a.tif") as opened:
        assert opened.crs.to_epsg() == 32734
        transform = opened.transform
    assert (transform.b, transform.d) == (0.0, 0.0)
    assert transform.e == -transform.a
    x, y = _middles(tmp_path / "a.tif").T
    error = np.hypot(*(np.stack(transform @ (x + 0.5, y + 0.5), axis=1) - truth).T)
    assert error.max() < 4 * METRES_PER_TEXEL
    assert transform.a == pytest.approx(METRES_PER_TEXEL / 0.7, rel=0.25)
    record = sidecar_of(tmp_path / "a.tif")["output"]["georeference"]
    assert (record["crs"], record["north_up"]) == ("EPSG:32734", True)
    assert (record["positions"], record["positions_used"]) == (6, 6)
    assert record["gsd_m"] == pytest.approx(transform.a)
    assert record["rms_m"] < 4 * METRES_PER_TEXEL
    assert map_summary(result.georeference) in [message.text for message in result.messages]


def test_the_references_frame_on_request(located: tuple[list[Path], FloatArray], cached: StitchOptions) -> None:
    paths = located[0]
    turned = [
        mosaic(paths, options=replace(cached, composite=CompositeOptions(scale=0.3, **given)))
        for given in ({"north_up": False}, {"rotate": 30.0})
    ]
    places = [result.georeference for result in turned]
    assert places[1].clockwise_deg == pytest.approx(places[0].clockwise_deg - 30.0, abs=1e-6)


def test_gsd_and_crs_as_requested(
    located: tuple[list[Path], FloatArray], cached: StitchOptions, tmp_path: Path
) -> None:
    paths, truth = located
    options = CompositeOptions(gsd=0.25, epsg=2048)  # Hartebeesthoek94 / Lo19
    mosaic(paths, tmp_path / "a.tif", replace(cached, composite=options))
    with rasterio.open(tmp_path / "a.tif") as opened:
        assert opened.crs.to_epsg() == 2048
        assert opened.res == pytest.approx((0.25, 0.25))
        x, y = _middles(tmp_path / "a.tif").T
        east, north = opened.transform @ (x + 0.5, y + 0.5)
        back = rasterio.warp.transform(opened.crs, "EPSG:32734", east, north)
    assert np.hypot(*(np.stack(back, axis=1) - truth).T).max() < 4 * METRES_PER_TEXEL + 0.05


def test_maps_are_checked_first(located: tuple[list[Path], FloatArray], cached: StitchOptions, tmp_path: Path) -> None:
    plain = flight(4, 2).write(tmp_path)
    for paths, options, message in (
        (plain, CompositeOptions(gsd=0.1), "gsd needs GPS positions of 3 images"),
        (located[0], CompositeOptions(epsg=4326), "EPSG:4326 is not a projected coordinate system"),
        (located[0], CompositeOptions(epsg=60000), "EPSG:60000 is not known"),
    ):
        with pytest.raises(ArgumentError, match=message):
            mosaic(paths, options=replace(cached, composite=options))


def test_bands_lie_like_the_first(
    located: tuple[list[Path], FloatArray], cached: StitchOptions, tmp_path: Path
) -> None:
    paths = located[0]
    options = CompositeOptions(scale=0.3)
    mosaic(paths, tmp_path / "a.tif", replace(cached, composite=options))
    (tmp_path / "band").mkdir()
    for path in paths:  # without positions
        with Image.open(path) as image:
            image.save(tmp_path / "band" / path.name)
    apply(tmp_path / "a.tif.json", [tmp_path / "band"], tmp_path / "b.tif", workers=1)
    apply(tmp_path / "a.tif.json", [tmp_path / "band"], tmp_path / "d.png", workers=1)
    assert "UTM_Zone_34S" in (tmp_path / "d.prj").read_text(encoding="ascii")
    (tmp_path / "e.pgw").write_text("mine", encoding="ascii")
    with pytest.raises(OutputError, match=r"e\.pgw: exists already"):
        apply(tmp_path / "a.tif.json", [tmp_path / "band"], tmp_path / "e.png", workers=1)
    coarse = CompositeOptions(gsd=0.5)
    apply(tmp_path / "a.tif.json", paths, tmp_path / "c.tif", replace(coarse, epsg=2048), workers=1)
    with rasterio.open(tmp_path / "c.tif") as other:
        assert (other.crs.to_epsg(), *other.res) == (2048, pytest.approx(0.5), pytest.approx(0.5))
    with rasterio.open(tmp_path / "a.tif") as one, rasterio.open(tmp_path / "b.tif") as two:
        assert (one.crs, one.shape) == (two.crs, two.shape)
        np.testing.assert_allclose(one.transform, two.transform, atol=1e-6)


def test_another_plane_has_another_place(
    located: tuple[list[Path], FloatArray], cached: StitchOptions, tmp_path: Path
) -> None:
    options, stitch = CompositeOptions(scale=0.3), replace(cached, reference=located[0][0].name)
    mosaic(located[0], tmp_path / "a.tif", replace(stitch, composite=options))
    options = replace(options, rectangle=(60.0, 60.0, 300.0, 40.0, 310.0, 240.0, 50.0, 220.0))
    expected = mosaic(located[0], options=replace(stitch, composite=options)).georeference
    found = apply(tmp_path / "a.tif.json", located[0], None, options, workers=1).georeference
    assert found is not None
    assert expected is not None
    np.testing.assert_allclose(found.pixel_to_map, expected.pixel_to_map, atol=0.02)


def test_others_get_a_world_file(located: tuple[list[Path], FloatArray], cached: StitchOptions, tmp_path: Path) -> None:
    paths, truth = located
    mosaic(paths, tmp_path / "a.jpg", cached)
    a, d, b, e, c, f = map(float, (tmp_path / "a.jgw").read_text(encoding="ascii").split())
    px = _middles(tmp_path / "a.jpg")
    place = np.column_stack([a * px[:, 0] + b * px[:, 1] + c, d * px[:, 0] + e * px[:, 1] + f])
    assert np.hypot(*(place - truth).T).max() < 4 * METRES_PER_TEXEL
    assert "UTM_Zone_34S" in (tmp_path / "a.prj").read_text(encoding="ascii")
    assert world_file_paths("field.ome.zarr") == ()
    mosaic(paths, tmp_path / "a.ome.tif", cached)
    with rasterio.open(tmp_path / "a.ome.tif") as ome:
        np.testing.assert_allclose(ome.transform[:6], (a, b, c, d, e, f), atol=0.6 * abs(a))
        assert ome.crs.to_epsg() == 32734


def test_files_beside_are_kept(located: tuple[list[Path], FloatArray], cached: StitchOptions, tmp_path: Path) -> None:
    (tmp_path / "a.prj").write_text("mine", encoding="ascii")
    with pytest.raises(OutputError, match=r"a\.prj: exists already"):
        mosaic(located[0], tmp_path / "a.jpg", cached)
    assert [(file.name, file.read_text(encoding="ascii")) for file in tmp_path.iterdir()] == [("a.prj", "mine")]


@dataclass(frozen=True)
class _Flight:
    """Images, by their positions and where they lie in the output."""

    positions: Sequence[GpsPosition | None]
    to_output: FloatArray
    camera: Camera = CAMERA
    control: Sequence[Sequence[GroundControl]] | None = None
    attitude: MeasuredTilt | None = None

    def place(self, epsg: int | None = None, *, force: bool = False) -> tuple[Georeference | None, str]:
        taken = [source(f"{k}.jpg", gps=position) for k, position in enumerate(self.positions)]
        control = self.control or [()] * len(taken)
        sources = [
            replace(each, camera=self.camera, control=tuple(points), attitude=self.attitude)
            for each, points in zip(taken, control, strict=True)
        ]
        found = place_on_map(sources, self.to_output, AlignmentErrors(), epsg, force=force)
        return found.place, found.reason or "".join(found.cautions)


def _row(count: int) -> _Flight:
    """Positions 7 m apart along a parallel, and images that lie along a curve."""
    to_output = np.stack([np.array([[250.0, 0, 300 * k], [0, 250.0, 4 * k**2], [0, 0, 1]]) for k in range(count)])
    return _Flight([GpsPosition(50.0, 8.0 + 1e-4 * k) for k in range(count)], to_output)


def test_positions_that_do_not_fit_are_refused() -> None:
    row = _row(8)
    place, reason = row.place()
    assert place is not None
    assert reason == ""
    assert "the image centres" in place.assumption
    mixed = replace(row, positions=[row.positions[k] for k in (4, 0, 7, 2, 5, 1, 6, 3)])
    place, reason = mixed.place()
    assert place is None
    assert "the GPS positions contradict the images" in reason
    place, again = mixed.place(force=True)
    assert place is not None
    assert again.partition(";")[0] == reason.partition(";")[0]
    place, reason = replace(row, positions=[*row.positions[:2], *[None] * 6]).place()
    assert place is None
    assert reason == "2 of 8 images have a GPS position, and 3 are needed"
    place, reason = replace(row, positions=[row.positions[0]] * 8).place()
    assert (place, reason) == (None, "all images have the same GPS position")
    in_one_place = replace(row, to_output=np.tile(row.to_output[:1], (8, 1, 1)))
    place, reason = in_one_place.place(force=True)
    assert place is None
    assert "no scale and direction of the map fit the GPS positions" in reason


@pytest.mark.parametrize(("wrong", "off"), [(GpsPosition(0.0, 1e-9), 5e6), (GpsPosition(50.0027, 8.0004), 300.0)])
def test_one_bad_position_of_eight_is_named_and_left_out(wrong: GpsPosition, off: float) -> None:
    row = _row(8)
    before, after = row.positions[:4], row.positions[5:]
    whole, _ = replace(row, positions=[*before, None, *after]).place()
    place, _ = replace(row, positions=[*before, wrong, *after]).place()
    assert (place.used, len(place.residuals)) == (7, 8)
    (rejected,) = place.rejected
    assert rejected.name == "4.jpg"
    assert rejected.distance == pytest.approx(off, rel=0.2)
    corner = [(0.0, 0.0)]
    np.testing.assert_allclose(place.to_map(corner), whole.to_map(corner), atol=0.1)


def test_an_attitude_of_a_table_says_what_is_below_a_camera() -> None:
    """With a homography for each image: of 5 degrees, 33 pixels of 380 beside the middle."""
    camera, sheared = Camera((400, 300), focal=380.0, focal_source="option"), _row(8).to_output.copy()
    sheared[:, 0, 1] = 1.0
    row = replace(_row(8), to_output=sheared, camera=camera)
    tilted = replace(row, attitude=MeasuredTilt((np.radians(5.0), 0.0)))
    plain, _ = row.place()
    place, _ = tilted.place()
    assert plain.assumption
    assert not place.assumption
    moved = (plain.origin - place.origin) / place.scale
    assert abs(moved.imag) == pytest.approx(380.0 * np.tan(np.radians(5.0)), rel=0.01)
    assert abs(moved.real) < 0.2


def test_what_lies_beyond_the_horizon_has_no_residual() -> None:
    row = _row(8)
    row.to_output[4] *= -1.0
    place, _ = row.place()
    assert place.rejected == (Residual("4.jpg", None, None, used=False),)
    texts = [message.text for message in place_messages(MapPlacement(place), stitched(registration()).placed)]
    assert "GPS positions that have no place in the output were not used: 4.jpg" in texts


def test_control_points_place_the_output_instead_of_positions() -> None:
    """A point in two images counts once; one that is 2 m off is named; the system is that of the list."""
    row = _row(8)
    truth = Georeference(Crs(32632), 0.05 * np.exp(0.2j), complex(448_000.0, 5_500_000.0))
    control: list[list[GroundControl]] = [[] for _ in row.positions]
    for number, (x, y) in enumerate(
        [(40.0, 90.0), (330.0, -80.0), (900.0, 70.0), (1000.0, 10.0), (1500.0, 130.0), (2100.0, 90.0)]
    ):
        ((east, north),) = truth.to_map([(x, y)]) + (2.0 if number == 4 else 0.0)
        latitude, longitude = Crs(32632).geographic([(east, north)])[0]
        for image in range(int(x // 300), int(x // 300) + 1 + (number == 1)):
            u, v = from_plane(row.camera, row.to_output[image], np.array([(x, y)]))[0]
            control[image].append(GroundControl(f"P{number}", GpsPosition(latitude, longitude), 32632, (u, v)))
    place, _ = replace(row, control=control).place()
    assert (place.crs, place.source, place.used) == (Crs(32632), "ground control points", 5)
    (rejected,) = place.rejected
    assert rejected.name == "P4"
    assert rejected.distance == pytest.approx(2.0 * 2**0.5, rel=0.01)
    np.testing.assert_allclose(
        place.to_map([(0.0, 0.0), (2000.0, 300.0)]), truth.to_map([(0, 0), (2000, 300)]), atol=0.01
    )
    assert max(r.distance for r in place.residuals if r.used) < 0.01
    few = [points if k < 2 else [] for k, points in enumerate(control)]
    assert "worst" in map_summary(place)
    assert "worst" not in map_summary(replace(place, residuals=()))  # as a sidecar may have it
    blind = replace(row, positions=[None] * len(row.positions), control=few)
    assert blind.place()[1] == "2 ground control points are in the images, and 3 are needed"


@pytest.mark.parametrize(("check", "count"), [(True, 3), (False, 2)])
def test_points_that_do_not_place_the_output_check_a_map_by_positions(check: bool, count: int) -> None:
    row = _row(8)
    truth, _ = row.place()
    points = []
    for k, pixel in enumerate([(40.0, 90.0), (100.0, 20.0), (130.0, 200.0)][:count]):
        ((latitude, longitude),) = truth.crs.geographic(truth.to_map([pixel]) + np.array([0.3, 0.0]))
        (seen,) = from_plane(row.camera, row.to_output[0], np.array([pixel]))
        known = GpsPosition(latitude, longitude)
        points.append(GroundControl(f"P{k}", known, 32632, tuple(seen.tolist()), check=check))
    place, caution = replace(row, control=[points, *[[]] * 7]).place()
    assert (place.source, place.scale, place.origin) == (truth.source, truth.scale, truth.origin)
    assert [one.name for one in place.checks] == [f"P{k}" for k in range(count)]
    assert [one.east for one in place.checks] == pytest.approx([-0.3] * count, abs=1e-3)
    few = "2 ground control points are in the images, and 3 are needed: GPS positions place the map, and these check it"
    assert caution == ("" if check else few)


@pytest.mark.parametrize(
    ("text", "epsg"),
    [
        ("EPSG:25832", 25832),
        ("WGS84 UTM 16N", 32616),
        ("WGS84 UTM 34 S", 32734),
        ("+proj=utm +zone=10 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", 32610),
        ("+proj=utm +zone=10 +south +datum=WGS84", 32710),
        ("+proj=longlat +datum=WGS84 +no_defs", 4326),
        ("+proj=utm +zone=10 +datum=WGS84 +units=us-ft", None),
        ("+proj=utm +zone=10 +ellps=intl +towgs84=-84,-107,-120,0,0,0,0", None),
        ("+proj=longlat +ellps=bessel", None),
    ],
)
def test_coordinate_systems_of_opendronemap(text: str, epsg: int | None) -> None:
    assert NamedSystem.named_by(text).epsg == epsg
    assert NamedSystem.named_by("name,lat,lon") is None


def test_units_and_datum_of_proj_count() -> None:
    place = np.array([[561_039.1578, 4_302_036.9052]])
    right = Crs(32629).geographic(place)
    feet = NamedSystem.named_by("+proj=utm +zone=29 +datum=WGS84 +units=us-ft +no_defs")
    np.testing.assert_allclose(feet.geographic(place * 3937 / 1200), right, atol=1e-8)
    datum = NamedSystem.named_by("+proj=utm +zone=29 +ellps=intl +towgs84=-84,-107,-120,0,0,0,0 +units=m +no_defs")
    np.testing.assert_allclose(datum.geographic([[561_158.7783, 4_302_250.3225]]), right, atol=1e-7)


@pytest.mark.parametrize("place", [(np.nan, 0.0), (0.0, np.nan), (100.0, 0.0)])
def test_there_is_no_zone_of_nowhere(place: tuple[float, float]) -> None:
    with pytest.raises(ArgumentError, match="no zone"):
        Crs.nearest(*place)


@pytest.mark.parametrize(
    ("latitude", "longitude", "epsg"),
    [
        (-17.0, [179.9, -179.9, 179.95, -179.95], 32701),
        (66.9, [179.9, -179.8, -179.9, 179.95], 32701 - 100),
        (0.0001, [-0.001, 0.001, 0.001, -0.0005], 32631),
        (-0.0001, [5.99, 6.02, 6.01, 6.0], 32732),
        (60.4, [5.3, 5.4, 5.3, 5.3], 32632),
        (78.2, [15.6, 15.7, 15.6, 15.6], 32633),
        (85.0, [100.0, 100.1, 100.0, 100.1], 32661),
        (-84.0, [-170.0, 170.0, 179.0, -179.0], 32761),
    ],
)
def test_the_map_of_places_all_round_the_world(latitude: float, longitude: list[float], epsg: int) -> None:
    """Its zone, and coordinates as PROJ has them, there and back."""
    assert Crs.nearest([latitude] * 4, longitude) == Crs(epsg)
    own = Crs(epsg).project([latitude] * 4, longitude)
    proj = rasterio.warp.transform("EPSG:4326", f"EPSG:{epsg}", longitude, [latitude] * 4)
    np.testing.assert_allclose(own, np.transpose(proj), atol=0.002)
    back = Crs(epsg).geographic(own)
    np.testing.assert_allclose(back, np.transpose([[latitude] * 4, longitude]), atol=1e-7)


def test_the_ground_sample_distance_is_that_on_the_ground() -> None:
    row = _row(8)
    utm_map, web = (row.place(epsg)[0] for epsg in (32632, 3857))
    assert web.gsd == pytest.approx(utm_map.gsd, rel=0.005)
    assert abs(web.scale) == pytest.approx(utm_map.gsd / np.cos(np.radians(50.0)), rel=0.005)
    other = utm_map.in_system(Crs(3857), [(0.0, 0.0), (2000.0, 100.0), (0.0, 300.0)])
    np.testing.assert_allclose(other.to_map([(1000.0, 0.0)]), web.to_map([(1000.0, 0.0)]), atol=0.02)
    assert other.gsd == pytest.approx(web.gsd, rel=0.002)


@pytest.mark.parametrize("scale", [0.5 + 0.0j, -0.5 + 0.0j, 0.3 - 0.4j])
def test_pixels_that_stay_keep_their_place(scale: complex) -> None:
    place = Georeference(Crs(32632), scale, 400_000.0 + 5_000_000.0j, 0.1)
    shifted = np.array([[1.0, 0.0, -7.0], [0.0, 1.0, 3.0], [0.0, 0.0, 1.0]])
    pixels = np.array([(0.0, 0.0), (100.0, 20.0)])
    assert place.after(np.eye(3)) == place
    np.testing.assert_allclose(place.after(shifted).to_map(pixels + shifted[:2, 2]), place.to_map(pixels))


def test_a_part_of_a_grid_whose_south_is_up_has_the_same_pixels() -> None:
    grid = MapGrid((100, 80), Georeference(Crs(32632), -0.5 + 0.0j, 400_000.0 + 5_000_000.0j))
    part = grid.within((399_960.25, 5_000_009.75, 399_990.25, 5_000_030.25))
    assert (part.size, part.place.scale) == ((60, 41), grid.place.scale)
    np.testing.assert_allclose(part.place.to_map([(0.0, 0.0)]), [(399_990.0, 5_000_010.0)])


def test_heights_on_a_map_are_metres_on_the_ground() -> None:
    """The map of the web is 1.6 times as large there; positions are those of the map."""
    flown = stitched(registration(2))
    of_plane = np.linalg.inv(flown.canvas.matrix)
    metres = 100.0 * of_plane[0, 0]  # 100 m to a height
    utm = Georeference(Crs(32631), complex(metres), 500_000.0 + 5_762_000.0j, 0.1)
    tables, ground = {}, utm.in_system(Crs(3857), flown.canvas.footprints[0])
    for place in (utm, ground):
        text = poses_table(replace(flown, georeference=place), "map")
        tables[place.crs.epsg] = [float(row["height"]) for row in csv.DictReader(text.splitlines())]
    assert ground.map_scale == pytest.approx(1.62, abs=0.01)
    assert tables[3857] == pytest.approx(tables[32631], rel=2e-3)
    assert tables[32631][0] == pytest.approx(100.0 * flown.registration.alignment.poses.height[0], rel=1e-6)


@pytest.mark.parametrize("pixel", [0.001, 0.05])
def test_a_grid_out_of_all_proportion_is_refused_before_anything_is_made_of_it(pixel: float) -> None:
    flown = stitched(registration(2))
    placed = replace(flown.placed, place=Georeference(Crs(32631), complex(0.05), 500_000.0 + 5_762_000.0j, 0.1))
    options = CompositeOptions(epsg=32631, gsd=pixel, extent=(400_000.0, 5_700_000.0, 600_000.0, 5_800_000.0))
    with pytest.raises(LimitError, match=r"the canvas would have .* pixels; choose a smaller extent, or larger pixels"):
        canvas_on_map(placed, options)


def test_an_image_beyond_the_horizon_leaves_the_others_their_pixel() -> None:
    cameras, straight = [Camera((400, 300), focal=380.0)] * 3, np.diag([250.0, 250.0, 1.0])
    behind = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    views = views_of(cameras, np.stack([straight, straight, behind]), [None] * 3)
    assert np.isnan(views.ground).tolist() == [False, False, True]
    assert views.pixel == pytest.approx(1.0)


def _survey(
    seed: int, tilt: tuple[float, float], yaw: float, std: float, slope: float = 0.0, altitude_std: float | None = None
) -> tuple[_Flight, Georeference]:
    """20 cameras 40 m up, of one tilt and yaws within ``yaw``, and the right place of their output."""
    rng = np.random.default_rng(seed)
    camera = Camera((480, 360), focal=400.0, focal_source="estimate", focal_std=0.4, tilt=tilt, tilt_std=(1e-4, 1e-4))
    truth = Georeference(Crs(32733), 0.1 * np.exp(0.3j), complex(500_000.0, 7_000_000.0))
    across, along = np.meshgrid(np.arange(5) * 150.0, np.arange(4) * 150.0)
    feet = np.stack([across.ravel(), along.ravel()], axis=1) + rng.normal(0.0, 10.0, (20, 2))
    heights = rng.normal(400.0, 8.0, 20)
    poses = Poses.of(feet, heights, rng.uniform(-yaw, yaw, 20), tilt)
    to_rays = np.diag([camera.scale / 400.0, camera.scale / 400.0, 1.0])
    to_output = np.asarray(np.linalg.inv(poses.from_plane()) @ to_rays, dtype=np.float64)
    # The ground falls by this slope towards the right of the output: cameras lean over it.
    places = truth.to_map(feet) + (truth.pixel_to_map[:, :1] * heights * slope).T + rng.normal(0.0, std, (20, 2))
    degrees = truth.crs.geographic(places)
    up = 100.0 + 0.1 * heights - 0.1 * slope * feet[:, 0]
    altitude = up if altitude_std is None else up + rng.normal(0.0, altitude_std, 20)
    known = altitude.tolist() if altitude_std is not None else [None] * 20
    positions = [GpsPosition(y, x, above) for (y, x), above in zip(degrees.tolist(), known, strict=True)]
    return _Flight(positions, to_output, camera), truth


@pytest.mark.parametrize(("yaw", "slope", "altitude_std"), [(0.0, 0.0, None), (3.0, 0.0, 3.0), (0.0, 0.05, 0.03)])
def test_positions_are_those_of_cameras(yaw: float, slope: float, altitude_std: float | None) -> None:
    """Image centres are 5.6 m from what is below a camera pitched by 8 degrees, and those of sloping ground 2 m."""
    flown, truth = _survey(1, (-0.14, 0.0), yaw, 0.02, slope, altitude_std)
    place, _ = flown.place()
    corners = [(-100.0, -100.0), (700.0, 600.0), (300.0, 300.0)]
    assert np.hypot(*(place.to_map(corners) - truth.to_map(corners)).T).max() < 0.1
    assert place.rms < 0.04
    assert not place.assumption
    assert "GPS agree with the map to 0.0" in map_summary(place)


@pytest.mark.parametrize("std", [0.02, 3.0])
def test_the_error_of_the_map_is_as_large_as_told(std: float) -> None:
    middle_of_field = [(300.0, 225.0)]
    errors, turns = [], []
    for seed in range(40):
        flown, truth = _survey(seed, (-0.05, 0.03), 3.0, std, altitude_std=2 * std)
        place, _ = flown.place()
        errors.append((place.to_map(middle_of_field) - truth.to_map(middle_of_field)) / place.std)
        turns.append(np.log(place.scale / truth.scale) / place.scale_std)
    assert 0.4 < np.mean(np.square(errors)) < 2.0
    assert np.abs(errors).max() < 5.0
    assert 0.4 < np.mean(np.abs(turns) ** 2) / 2.0 < 2.0


def test_poses_on_a_map_say_that_nobody_knows_how_high_they_are(
    located: tuple[list[Path], FloatArray], cached: StitchOptions, tmp_path: Path
) -> None:
    options = replace(cached, pose_covariance=True, composite=CompositeOptions(scale=0.3))
    beside = FilesBeside(poses=tmp_path / "p.csv", frame="map")
    result = mosaic(located[0], tmp_path / "a.tif", options, beside=beside)
    assert [message.code for message in result.messages].count("focal-unknown") == 1
    table = np.genfromtxt(tmp_path / "p.csv", delimiter=",", names=True)
    true, std = METRES_PER_TEXEL * flight(4, 3, 2).poses.height, np.sqrt(table["cov_height_height"])
    assert (std > 0.05 * true).all()
    assert (np.abs(table["height"] - true) < 3.0 * std).all()
    # What GPS says of places: images leave a third of such lengths open.
    assert (np.sqrt(table["cov_x_x"] + table["cov_y_y"]) < 0.1 * true).all()


def test_positions_and_gcp_of_files(
    located: tuple[list[Path], FloatArray], cached: StitchOptions, tmp_path: Path
) -> None:
    """Also where EXIF has none; the residuals are in the sidecar, the report, and the sidecar of what is applied."""
    truth = located[1]
    plain = flight(4, 3, 2).write(tmp_path, "f{}.jpg")
    rows = [f"{path.name},{east},{north}" for path, (east, north) in zip(plain, truth.tolist(), strict=True)]
    (tmp_path / "p.csv").write_text("\n".join(["name,x,y", *rows]), encoding="utf-8")
    small = CompositeOptions(scale=0.3, epsg=32734)
    options = replace(cached, positions=tmp_path / "p.csv", composite=small)
    by_positions = mosaic(plain, options=options).georeference
    lines = [
        f"{east} {north} 0 199.5 149.5 {path.name} {path.stem}"
        for path, (east, north) in zip(plain, truth, strict=True)
    ]
    elsewhere = "0 0 0 1 1 misspelt.jpg P"
    (tmp_path / "gcp.txt").write_text("\n".join(["EPSG:32734", *lines, elsewhere]), encoding="utf-8")
    options = replace(cached, gcp=tmp_path / "gcp.txt", composite=replace(small, epsg=None))
    result = mosaic(plain, tmp_path / "a.tif", options)
    assert any("1 of 7 lines are of none of the images (misspelt.jpg P)" in m.text for m in result.messages)
    assert by_positions.used == 6
    np.testing.assert_allclose(result.georeference.pixel_to_map, by_positions.pixel_to_map, atol=0.1)
    record = sidecar_of(tmp_path / "a.tif")["output"]["georeference"]
    assert record["source"] == "ground control points"
    away = {r["name"]: np.hypot(r["east_m"], r["north_m"]) for r in record["residuals"]}
    assert away.keys() == {path.stem for path in plain}
    assert max(away.values()) < 4 * METRES_PER_TEXEL
    assert "f0" in report_page(result).partition("Place on the Earth")[2][:3000]
    applied = apply(tmp_path / "a.tif.json", plain, workers=1)
    np.testing.assert_allclose(applied.georeference.pixel_to_map, result.georeference.pixel_to_map, rtol=1e-12)
    assert applied.georeference.residuals == result.georeference.residuals
    table = np.genfromtxt(poses_table(result, "map").splitlines(), delimiter=",", names=True)
    # The camera is above the middle of its image but for the tilt, which is the same in all.
    off = np.stack([table["x"], table["y"]], axis=1) - truth
    assert np.abs(off).max() < 0.1 * table["height"].mean()
    assert np.ptp(off, axis=0).max() < 8 * METRES_PER_TEXEL
    assert np.ptp(table["yaw_deg"]) < 30.0
    c, s = np.cos(0.4), np.sin(0.4)
    upright = np.array([[c, -s, 3.0], [s, c, 1.0], [0.0, 0.0, 1.0]]), np.array([[1.0, 0, 0], [0, 1, 0], [0.1, 0, 1]])
    turned, tilted = (
        replace(result, canvas=replace(result.canvas, orientation=by, matrix=result.canvas.matrix @ np.linalg.inv(by)))
        for by in upright
    )
    _check_colmap(result, plain, truth, tmp_path)
    again = np.genfromtxt(poses_table(turned, "map").splitlines(), delimiter=",", names=True)
    assert again["x"] == pytest.approx(table["x"], abs=1e-3)
    assert again["yaw_deg"] == pytest.approx(table["yaw_deg"], abs=1e-5)
    with pytest.raises(ArgumentError, match="the plane was tilted to be upright"):
        poses_table(tilted, "map")
    blind = mosaic(plain, options=replace(options, gcp=None))
    with pytest.raises(ArgumentError, match="there is no map for the poses: 0 of 6 images have a GPS position"):
        poses_table(blind, "map")


def test_images_without_positions_leave_no_world_file(cached: StitchOptions, tmp_path: Path) -> None:
    mosaic(flight(4, 2).write(tmp_path), tmp_path / "a.png", cached)
    assert not list(tmp_path.glob("*.pgw"))
    assert not list(tmp_path.glob("*.prj"))


def test_gdal_sees_what_was_meant(tmp_path: Path) -> None:
    place = Georeference(Crs(32734), 0.05 * np.exp(0.3j), complex(268_832.3, 6_246_117.8), 0.1)
    layout = ImageSpec((900, 600), 3, np.dtype(np.uint8))
    write_strips(tmp_path / "a.tif", layout, [(np.full((600, 900, 3), 9, np.uint8), None)], place.tiff_tags())
    with rasterio.open(tmp_path / "a.tif") as opened:
        assert opened.crs.to_epsg() == place.crs.epsg
        for x, y in ((0, 0), (899, 599), (300, 20)):
            np.testing.assert_allclose(opened.xy(y, x), place.to_map([(x, y)])[0], atol=1e-6)


def _check_colmap(result: StitchResult, paths: list[Path], middles: FloatArray, folder: Path) -> None:
    """COLMAP projects places of the ground to where the images show them, and OpenDroneMap's list has the cameras."""
    pycolmap = pytest.importorskip("pycolmap")
    (folder / "model").mkdir()
    camera = result.registration.camera
    (folder / "model/cameras.txt").write_text(camera_file_text(camera, "cameras.txt"), encoding="utf-8")
    (folder / "model/images.txt").write_text(poses_file(result, "images.txt"), encoding="utf-8")
    (folder / "model/points3D.txt").write_text("", encoding="utf-8")
    model = pycolmap.Reconstruction(folder / "model")
    first = poses_file(result, "images.txt").splitlines()[0]
    origin = np.array([float(value) for value in first.rpartition(": ")[2].split()])
    images = {image.name: image for image in model.images.values()}
    for path, middle in zip(paths, middles, strict=True):
        seen = images[path.name].project_point(np.array([*middle, 0.0]) - origin)
        # COLMAP counts from the corner of the first pixel.
        assert np.abs(seen - (200.0, 150.0)).max() < 3.0
    rows = poses_file(result, "geo.txt").splitlines()
    assert rows[0] == "EPSG:32734"
    listed = np.array([[float(value) for value in row.split()[1:4]] for row in rows[1:]])
    centres = np.array([images[path.name].projection_center() for path in paths]) + origin
    np.testing.assert_allclose(listed, centres, atol=1e-3)


def test_a_strip_that_drifts_bends_back_onto_its_control_points(tmp_path: Path) -> None:
    """With a lens that is a little wrong; points that take no part come nearer too."""
    sequence = flight(5, 14, 1, overlap=0.4)
    paths = sequence.write(tmp_path, "s{:02}.jpg")
    pixels = np.random.default_rng(0).uniform((60, 60), (340, 240), (14, 2))
    places = np.concatenate([sequence.to_plane(k, pixels[k : k + 1]) for k in range(14)])
    places = np.array([268_000.0, 6_346_000.0]) + places * (METRES_PER_TEXEL, -METRES_PER_TEXEL)
    lines = [
        f"{x} {y} 0 {u} {v} {path.name} P{k}"
        for k, (path, (x, y), (u, v)) in enumerate(zip(paths, places.tolist(), pixels.tolist(), strict=True))
    ]
    for name, chosen in (("gcp", lines[::3]), ("checks", lines[1::3])):
        (tmp_path / f"{name}.txt").write_text("\n".join(["EPSG:32734", *chosen]), encoding="utf-8")
    options = StitchOptions(
        workers=1, distortion=DISTORTION - 0.03, cache=tmp_path / "cache", composite=CompositeOptions(scale=0.2)
    )
    held = mosaic(paths, options=replace(options, gcp=tmp_path / "gcp.txt", check_points=tmp_path / "checks.txt"))
    alignment = mosaic(paths, options=options).registration.alignment

    seen = [to_plane(alignment.cameras[k], alignment.homographies[k], pixels[k : k + 1])[0] for k in range(14)]
    fit = fit_similarity(np.array(seen) @ [1.0, -1.0j], places @ [1.0, 1.0j], 1e3)
    without, checks = fit.residuals[1::3], np.array([check.distance for check in held.georeference.checks])
    assert np.sqrt(np.mean(checks**2)) < 0.5 * np.sqrt(np.mean(without**2))
    assert np.sqrt(np.mean(checks**2)) < 3.0 * held.georeference.rms
