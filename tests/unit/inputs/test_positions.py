"""Positions of images: of EXIF, and of files in all their forms."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rdstitch.errors import InputError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.crs import Crs
from rdstitch.geometry.places import GpsPosition
from rdstitch.inputs.attitudes import with_attitudes
from rdstitch.inputs.find import find_images
from rdstitch.inputs.ground_control import with_ground_control
from rdstitch.inputs.positions import positions_of, with_positions
from rdstitch.inputs.source import Source, read_sources
from rdstitch.inputs.times import timestamps_of, with_times
from rdstitch.io.metadata import Metadata
from rdstitch.results.messages import Message
from rdstitch.stage.positions import grid_from_table


def _source(gps: GpsPosition | None) -> Source:
    return Source(Path("image.jpg"), Metadata((640, 480), gps=gps), Camera((640, 480)))


def test_distances_are_those_on_the_ground_at_any_place() -> None:
    """Also across the date line, and where a degree of longitude is short; east and north are where they should be."""
    west, east = GpsPosition(70.0, 179.9995), GpsPosition(70.0, -179.9995, 120.0)
    north = GpsPosition(70.001, 179.9995)
    one, two, three = positions_of([_source(west), _source(east), _source(north)])
    assert np.isclose(np.linalg.norm(one - two), 38.187, rtol=1e-3)  # on the ellipsoid
    assert np.isclose(np.linalg.norm(one - three), 111.562, rtol=1e-3)
    assert two[0] - one[0] > 30.0
    assert three[1] - one[1] > 110.0


def test_an_image_without_gps_is_nowhere() -> None:
    places = positions_of([_source(None), _source(GpsPosition(1.0, 2.0))])
    assert np.isnan(places[0]).all()
    assert np.isfinite(places[1]).all()
    assert positions_of([]).shape == (0, 2)


NAMES = ("a.jpg", "b.jpg", "c.jpg")
START = 1_700_000_000.0  # 2023-11-14 22:13:20 UTC


def _sources() -> list[Source]:
    return [
        Source(
            Path("flight") / name,
            Metadata((640, 480), gps=GpsPosition(1.0, 1.0), timestamp=START + 10.0 * k),
            Camera((640, 480)),
        )
        for k, name in enumerate(NAMES)
    ]


def _read(folder: Path, text: str, epsg: int | None = None, offset: float = 0.0) -> list[GpsPosition | None]:
    (folder / "positions").write_text(text, encoding="utf-8")
    return [source.metadata.gps for source in with_positions(_sources(), folder / "positions", epsg, offset)]


# As `exiftool -csv -gpslatitude -gpslongitude -gpsaltitude` writes them, without and with -n, and others.
@pytest.mark.parametrize(
    "text",
    [
        'SourceFile,GPSAltitude,GPSLatitude,GPSLongitude\n./a.jpg,35.5 m Above Sea Level,"48 deg 51\' 29.60"" N",'
        '"2 deg 17\' 40.20"" W"\nx/b.jpg,-,"48 deg 51\' 29.60"" S","2 deg 17\' 40.20"" E"\nc.jpg,,,\n',
        "SourceFile,GPSAltitude,GPSLatitude,GPSLongitude\na.jpg,35.5,48.8582222222,-2.2945\nb.jpg,,-48.8582222222,2.2945\n",
        "SourceFile,GPSLatitudeRef,GPSLatitude,GPSLongitudeRef,GPSLongitude,GPSAltitude\n"
        "a.jpg,North,48.8582222222,West,2.2945,35.5\nb.jpg,S,48.8582222222,E,2.2945,\n",
        "# Name;Lat [deg];Lon [deg];Alt (m)\n"
        "C:\\flight\\a.jpg;48,8582222222;-2,2945;35,5\nb.jpg;-48,8582222222;2,2945\n",
        "EPSG:4326\nname,x,y,z\na.jpg,-2.2945,48.8582222222,35.5\nb.jpg,2.2945,-48.8582222222,\n",
        "EPSG:4326\na.jpg -2.2945 48.8582222222 35.5 0 0 0\n\nb.jpg 2.2945 -48.8582222222\n",
        "EPSG:4326\n# name,x,y,z\na.jpg,-2.2945,48.8582222222,35.5\nb.jpg,2.2945,-48.8582222222\n",
        "EPSG:4326\n# name, x, y\na.jpg -2.2945 48.8582222222 35.5\nb.jpg 2.2945 -48.8582222222\n",
        "EPSG:4326\n# name, x, y\na.jpg -2,2945 48,8582222222 35,5\nb.jpg 2,2945 -48,8582222222\n",
        "\n# of flight 3\nEPSG:4326\na.jpg -2.2945 48.8582222222 35.5\nb.jpg 2.2945 -48.8582222222\n",
    ],
)
def test_tables(tmp_path: Path, text: str) -> None:
    one, two, three = _read(tmp_path, text)
    assert three is None
    assert (one.latitude, one.longitude, one.altitude) == pytest.approx((48.8582222222, -2.2945, 35.5), abs=1e-9)
    np.testing.assert_allclose((two.latitude, two.longitude), (-48.8582222222, 2.2945), atol=1e-9)
    assert two.altitude is None


def test_json_with_groups_takes_the_value_with_a_sign(tmp_path: Path) -> None:
    record = {"SourceFile": "b.jpg", "EXIF:GPSLatitude": 33.9, "Composite:GPSLatitude": -33.9, "GPSLongitude": 18.5}
    place = _read(tmp_path, json.dumps([record]))[1]
    assert place == GpsPosition(-33.9, 18.5)


@pytest.mark.parametrize(
    "altitude",
    ["430 m Below Sea Level,", "430 m,Below Sea Level", "430,1", "-430,1.0", "430,3", "430 m,Negative Sea Level (…)"],
)
def test_altitudes_below_the_sea(tmp_path: Path, altitude: str) -> None:
    heading = "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude,GPSAltitudeRef\n"
    rows = f"a.jpg,31.5,35.5,{altitude}\nb.jpg,31.5,35.5,1,0\nc.jpg,31.5,35.5,3 m,Above Sea Level\n"
    assert [place and place.altitude for place in _read(tmp_path, heading + rows)] == [-430.0, 1.0, 3.0]


@pytest.mark.parametrize("head", ["name,x,y,z", "EPSG:32734", "epsg:32734+5773"])
def test_projected_coordinates(tmp_path: Path, head: str) -> None:
    rows = ["a.jpg,268832.2996,6246117.7881,12", "b.jpg,268932.2996,6246117.7881,12"]
    if named := head.lower().startswith("epsg"):
        rows = [row.replace(",", " ") for row in rows]
    one, two, _ = _read(tmp_path, "\n".join([head, *rows]), None if named else 32734)
    assert (one.latitude, one.longitude, one.altitude) == pytest.approx((-33.9, 18.5, 12.0), abs=1e-7)
    np.testing.assert_allclose(Crs(32734).project([two.latitude], [two.longitude])[0, 0], 268932.2996, atol=1e-3)


@pytest.mark.parametrize(
    ("latitude", "longitude"),
    [
        ("S33.85", "W 122.5"),
        ("S 33 51", "122°30'0″W"),
        ("33d 51m 0s S", "W122d30m0s"),
        ("\u221233.85", "-122.5"),
        ("33.85S", "122.5W"),
        ("33.85S", "-122.5"),
        ("33.85 S", '"122°30\'0"" W"'),
        ('"33 deg 51\' 0.00"" S"', "122.5 W"),
    ],
)
def test_the_side_may_stand_before_or_after(tmp_path: Path, latitude: str, longitude: str) -> None:
    place = _read(tmp_path, f"name;lat;lon\na.jpg;{latitude};{longitude}\n")[0]
    assert (place.latitude, place.longitude) == pytest.approx((-33.85, -122.5))


GPX = """<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="10.0" lon="179.999"><ele>100</ele><time>2023-11-14T22:13:10Z</time></trkpt>
<trkpt lat="10.002" lon="-179.999"><ele>120</ele><time>2023-11-14T23:13:30+01:00</time></trkpt>
</trkseg></trk></gpx>"""


def test_images_have_their_places_on_a_track_by_their_times(tmp_path: Path) -> None:
    one, two, three = _read(tmp_path, GPX)
    assert (one.latitude, one.altitude) == pytest.approx((10.001, 110.0))
    assert abs(abs(one.longitude) - 180.0) < 1e-9
    assert (two.latitude, two.longitude, two.altitude) == pytest.approx((10.002, -179.999, 120.0))
    assert three is None
    shifted = _read(tmp_path, GPX, offset=-20.0)
    assert [place is not None for place in shifted] == [False, True, True]
    # A waypoint is no point of the track.
    waypoint = '<wpt lat="46" lon="7"><time>2023-11-14T22:13:20Z</time></wpt>'
    assert _read(tmp_path, GPX.replace("<trk>", f"{waypoint}<trk>")) == [one, two, three]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names no columns like name,latitude,longitude or name,x,y"),
        (
            "ETRS89 / UTM 32N\na.jpg 5e5 5e6\n",
            "names no columns like name,latitude,longitude or name,x,y: 'ETRS89 / UTM",
        ),
        ("name,lat,lon\n", "has no rows below its heading"),
        ("name,lat,lon\nz.jpg,1,2\n", "has no position of a.jpg"),
        ("name,lat,lon\na.jpg,1,2\na.jpg,1,2\n", "line 3: a.jpg is here twice"),
        ("name,lat,lon\na.jpg,91,2\n", "line 2: expected latitude and longitude in degrees, not 91 and 2"),
        ("name,x,y\na.jpg,500000,91\n", "line 2: in which coordinate system x and y are is not known; give --crs"),
        ("EPSG:32633\na.jpg 1e12 1e12\n", "EPSG:32633 has no such places"),
        ('{"a": 1}', "expected a list of objects"),
        ("<gpx></gpx>", "has no points with a time"),
        ("<gpx>", "is not XML"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><gpx/>", "defines entities"),
        (GPX.replace("2023", "2022"), "the track goes from 2022-11-14T22:13:10 to 2022-11-14T22:13:30 UTC, the images"),
        (GPX.replace('lat="10.0"', 'lat="x"'), "cannot be read"),
        ("1\n00:00:00,000 --> 00:00:00,033\n[latitude: 1.2.3] [longitude: 4.0]\n", ""),
        ("1\t43.6\t[2107]\t-4,N\t-16,E\t194,V\t22.6.1,Lat\t-113.8,Lon\t76.4,Ellh\t0.01, 0.01, 0.02\t50,Q", ""),
        (
            'name,GPSLatitude,GPSLongitude\na.jpg,"48 deg 51\' 29.60""","2 deg 17\' 40.20"" W"\n',
            "does not say whether north or south, east or west",
        ),
        (
            "name,lat,lon\na.jpg,33.85 E,5 N\n",
            "line 2: expected a latitude like 33.85, -33.85 or 33 51 S",
        ),
        ("name,lat,lon\na.jpg,33.85 S,5 O\n", "line 2: expected a longitude like"),
        ("name;lat;lon\na.jpg;33 75 00 S;5 E\n", "line 2: expected a latitude like"),
        ("name;lat;lon\na.jpg;33 51 60 S;5 E\n", "line 2: expected a latitude like"),
        ("name;lat;lon\na.jpg;48.5 30 N;5 E\n", "line 2: expected a latitude like"),
        ("name;lat;lon\na.jpg;48 51 29 6 N;5 E\n", "line 2: expected a latitude like"),
        ("name;lat;lon\na.jpg;48.8584, 2.2945;5 E\n", "line 2: expected a latitude like"),
        ("name,lat,lon\na.jpg,48,8582,2,2945\n", "line 2: has 5 fields"),
        ("name,lat,lon\na.jpg,1,2\nb.jpg,oops,2\n", "line 3: expected a number for latitude, not 'oops'"),
        ("EPSG:32633\na.jpg 5e5 5e6\nb.jpg oops 5e6\n", "line 3: expected a name and numbers between blanks, not 'b"),
        ("EPSG:32633\na.jpg 5e5 5e6\nb.jpg 500000m 5e6 100 0\n", "line 3: expected a name and numbers between blanks"),
        ("EPSG:32633\na.jpg 5e5 5e6\nb.jpg 5e5 5e6 w/o 5 6\n", "line 3: expected a name and numbers between blanks"),
        ("EPSG:32633\na.jpg 5e5 5e6\nb.jpg x y w/o 5 6\n", "line 3: expected a name and numbers between blanks"),
        ("EPSG:32633\na.jpg 5e5 5e6\nb.jpg 5e5 oops 100\n", "line 3: expected a name and numbers between blanks"),
        ("EPSG:32633\na.jpg 5e5 5e6\nb.jpg 5e5 5e6 1OO 0\n", "line 3: expected a name and numbers between blanks"),
        ("EPSG:32633\na.jpg 5e5 5e6 9 0 0 0 .02m .04\n", "line 2: expected a name and numbers between blanks"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match="positions: .*" + re.escape(message)):
        _read(tmp_path, text)


def test_control_points(tmp_path: Path) -> None:
    file = tmp_path / "gcp_list.txt"
    file.write_text(
        "WGS84 UTM 34S\n268832.2996 6246117.7881 12.1 300.5 200 a.jpg P1\n"
        "268832.2996 6246117.7881 12.1 10 20 b.jpg P1\n"
        "268900 6246200 12 1 2 elsewhere.jpg\n268900 6246200 12 1 2 c.jpg\n",
        encoding="utf-8",
    )
    told = list[Message]()
    one, two, three = (source.control for source in with_ground_control(_sources(), file, report=told.append))
    assert [(message.severity, message.text) for message in told] == [
        ("note", f"{file}: 1 of 4 lines are of none of the images (elsewhere.jpg)")
    ]
    assert [(c.name, c.epsg, c.pixel) for c in (*one, *two)] == [
        ("P1", 32734, (300.5, 200.0)),
        ("P1", 32734, (10.0, 20.0)),
    ]
    np.testing.assert_allclose((one[0].place.latitude, one[0].place.longitude), (-33.9, 18.5), atol=1e-7)
    assert three[0].name == "268900 6246200"
    (tmp_path / "bare.txt").write_text(file.read_text().partition("\n")[2], encoding="utf-8")
    bare = with_ground_control(_sources(), tmp_path / "bare.txt", 32734)
    assert [source.control for source in bare] == [one, two, three]
    sources = [replace(source, path=Path(f"DJI {source.name}")) for source in _sources()]
    file.write_text("WGS84 UTM 34S\n268832 6246117 12 1 2 DJI a.jpg the post\n268832 6246117 12\t3\t4\tDJI b.jpg\n")
    one, two, _ = (source.control for source in with_ground_control(sources, file))
    assert [(c.name, c.pixel) for c in (*one, *two)] == [("the post", (1.0, 2.0)), ("268832 6246117", (3.0, 4.0))]


@pytest.mark.parametrize(
    ("lines", "name"),
    [
        ("# x, y, z, px, py, image\n500000 5300000 5 30 20 a.jpg", "500000 5300000"),
        (
            "# x, y, z, px, py, image\n500000 5300000 5 30,0 20 a.jpg\n500010,5 5300000 5 1,125 20 elsewhere, b.jpg",
            "500000 5300000",
        ),
        ("# x, y, z of Bob\n500000 5300000 5 30 20 a.jpg corner, NE", "corner, NE"),
        ("500000\t5300000\t5\t30\t20\ta.jpg", "500000 5300000"),
        ("# x;y;px;py;image\n500000;5300000;30;20;a.jpg", "500000 5300000"),
    ],
)
def test_a_list_of_control_points_is_told_from_a_table(tmp_path: Path, lines: str, name: str) -> None:
    (tmp_path / "gcp").write_text(f"EPSG:32632\n{lines}\n", encoding="utf-8")
    (point,) = with_ground_control(_sources(), tmp_path / "gcp")[0].control
    assert (point.name, point.pixel) == (name, (30.0, 20.0))


def test_latitude_and_longitude_are_what_they_are_whatever_system_a_list_names(tmp_path: Path) -> None:
    rows = "image,latitude,longitude,px,py,label\na.jpg,46.2,7.1,30,20,1\nb.jpg,46 12 0 N,7.1,30,20,2\n"
    (tmp_path / "gcp").write_text(f"EPSG:32632\n{rows}", encoding="utf-8")
    one, two, _ = (source.control for source in with_ground_control(_sources(), tmp_path / "gcp"))
    assert [(c.place.latitude, c.place.longitude, c.epsg) for c in (*one, *two)] == [(46.2, 7.1, 4326)] * 2
    (tmp_path / "gcp").write_text(f"{rows}c.jpg,,7.1,30,20,3\n", encoding="utf-8")
    with pytest.raises(InputError, match="line 4: has no coordinates"):
        with_ground_control(_sources(), tmp_path / "gcp")


def test_images_that_a_list_of_positions_lacks_are_named(tmp_path: Path) -> None:
    told = list[Message]()
    for rows in ("a.jpg,1,2\nB0.jpg,1,3\nc.jpg,,\n", "a.jpg,1,2\nb.jpg,1,3\nc.jpg,1,4\nof the next flight.jpg,1,5\n"):
        (tmp_path / "p.csv").write_text(f"name,lat,lon\n{rows}", encoding="utf-8")
        with_positions(_sources(), tmp_path / "p.csv", report=told.append)
    (message,) = told
    assert message.severity == "note"
    assert message.text == f"{tmp_path / 'p.csv'}: has no position of 2 of 3 images (b.jpg, c.jpg)"


def test_projected_numbers_in_other_notations_and_zero_longitude(tmp_path: Path) -> None:
    place = _read(tmp_path, 'name,x,y\na.jpg,"268,832.2996","6,246,117.7881"\n', 32734)[0]
    assert (place.latitude, place.longitude) == pytest.approx((-33.9, 18.5), abs=1e-7)
    assert _read(tmp_path, '[{"SourceFile": "a.jpg", "GPSLatitude": 51.5, "GPSLongitude": 0}]')[0] == GpsPosition(
        51.5, 0
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3 4 5 a.jpg", "line 1: expected a coordinate system"),
        ("EPSG:4326\n1 2 3 4 a.jpg", "line 2: expected X Y Z PX PY IMAGE"),
        ("\n# surveyed\nEPSG:4326\n1 2 3 4 a.jpg", "line 4: expected X Y Z PX PY IMAGE"),
        ("EPSG:4326\n# Bob, 2024\n1 2 3 4 a.jpg", "line 3: expected X Y Z PX PY IMAGE"),
        ("EPSG:4326\n# Bob 2024\nx,y,px,py,image\n1,2,x,4,a.jpg", "line 4: expected a number for px, not 'x'"),
        ("EPSG:4326\nx,y,px,py,name\n1,2,3,4,a.jpg", "names no columns like x,y,px,py,image or longitude"),
        ("EPSG:4326\n1 2 3 640 5 a.jpg", "line 2: is not within the 640 x 480 pixels of a.jpg"),
        ("EPSG:4326\n1 2 3 nan 5 a.jpg", "line 2: has no number for px"),
        ("EPSG:4326\n1 2 3 4 5 z.jpg", "has no ground control point in any of the images"),
    ],
)
def test_wrong_control_points_are_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "gcp").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=re.escape(message)):
        with_ground_control(_sources(), tmp_path / "gcp")


def test_subtitles_of_a_video_are_a_track(tmp_path: Path) -> None:
    """As DJI writes them, newer and older; images have their places by their times."""
    new = "[latitude: 10.0] [longitude: 179.999] [rel_alt: 1.3 abs_alt: 100.0] </font>"
    old = "GPS(-179.999,10.002,19) BAROMETER:1.9"
    text = f"1\n00:00:00,000 --> 00:00:00,033\n{new}\n\n2\n00:00:20,000 --> 00:00:20,033\n{old}\n"
    one, two, three = _read(tmp_path, text, offset=-START + 10.0)
    assert (one.latitude, abs(one.longitude)) == pytest.approx((10.001, 180.0))
    assert (two.latitude, two.longitude) == pytest.approx((10.002, -179.999))
    assert three is None


def test_events_of_a_receiver_have_positions_with_accuracies(tmp_path: Path) -> None:
    lines = [
        f"{k}\t435237.6{k}\t[2107]\t   -4,N\t  -16,E\t 194,V\t22.6{k},Lat\t-113.8{k},Lon\t76.412,Ellh\t"
        "0.012, 0.016, 0.029\t50,Q"
        for k in (1, 2, 3)
    ]
    (tmp_path / "t.MRK").write_text("\n".join(lines), encoding="utf-8")
    numbers = zip(_sources(), (3, 1, 9), strict=True)
    named = [replace(source, path=Path(f"DJI_20230101_000{k}_V.JPG")) for source, k in numbers]
    one, two, three = (s.metadata.gps for s in with_positions(named, tmp_path / "t.MRK"))
    assert (one.latitude, one.longitude, one.altitude) == (22.63, -113.83, 76.412)
    assert one.std == pytest.approx((0.0141421, 0.029), abs=1e-6)
    assert two.latitude == 22.61
    assert three is None
    with pytest.raises(InputError, match="has events 1 to 3, which the numbers at the end of the names"):
        with_positions(_sources(), tmp_path / "t.MRK")


def test_names_in_other_case_and_accuracies_in_tables(tmp_path: Path) -> None:
    header = "name,lat,lon,RtkStdLat,RtkStdLon,RtkStdHgt"
    one, two, _ = _read(tmp_path, f"{header}\nA.JPG,1,2,0.03,0.04,0.05\nb.jpg,1,3,,,\n")
    assert one.std == pytest.approx((0.05 / 2**0.5, 0.05))
    assert two == GpsPosition(1.0, 3.0)
    geo = "EPSG:4326\na.jpg 2 1 50 0 0 0 0.02 0.04 fixed 3D\nb.jpg 3 1\n"
    assert _read(tmp_path, geo)[0].std == (0.02, 0.04)


def test_control_points_of_images_with_spaces_in_other_case_and_to_check(tmp_path: Path) -> None:
    sources = [replace(source, path=Path(f"my {source.name}")) for source in _sources()]
    (tmp_path / "gcp.txt").write_text(
        "EPSG:32632\n500000 5000000 0 10 20 My A.JPG corner one\n500010 5000000 0 30 20 my b.jpg\n", encoding="utf-8"
    )
    read = with_ground_control(with_ground_control(sources, tmp_path / "gcp.txt"), tmp_path / "gcp.txt", check=True)
    assert [(point.name, point.check) for point in read[0].control] == [("corner one", False), ("corner one", True)]
    assert read[1].control[0].name == "500010 5000000"


def test_control_points_as_a_table_with_accuracies(tmp_path: Path) -> None:
    rows = "px;py;image;name;x;y;accuracy\n300.5;200;flight\\a.jpg;P 1;268832.2996;6246117.7881;0.02\n1;2;b.jpg;;1;2;\n"
    (tmp_path / "gcp.csv").write_text(f"EPSG:32734\n{rows}", encoding="utf-8")
    (tmp_path / "plain.csv").write_text(rows, encoding="utf-8")
    one, two, _ = (source.control for source in with_ground_control(_sources(), tmp_path / "gcp.csv"))
    assert [(c.name, c.pixel, c.std) for c in (*one, *two)] == [("P 1", (300.5, 200), 0.02), ("1 2", (1, 2), None)]
    assert with_ground_control(_sources(), tmp_path / "plain.csv", 32734)[0].control == one
    with pytest.raises(InputError, match="--crs"):
        with_ground_control(_sources(), tmp_path / "plain.csv")


def test_names_in_lists_hold_blanks_and_words_follow_the_numbers(tmp_path: Path) -> None:
    lines = [
        "DJI 0001 (2).jpg 12.5 48 -3",
        "# no\n\nb.jpg 1 2",
        "c.jpg 1 2 3 4 5 6 7 8 fixed 30 sats",
        "d.jpg 1 2 RTK",
        "v1.old shots/IMG1 1 2",
        "IMG 2024 01 15 x.jpg 1 2 3 fixed",
    ]
    (tmp_path / "geo.txt").write_text("EPSG:4326\n" + "\n".join(lines))
    names = ("DJI 0001 (2).jpg", "b.jpg", "c.jpg", "d.jpg", "IMG1", "IMG 2024 01 15 x.jpg")
    sources = [Source(Path(name), Metadata((640, 480)), Camera((640, 480))) for name in names]
    places = [source.metadata.gps for source in with_positions(sources, tmp_path / "geo.txt")]
    assert [place and (place.longitude, place.latitude, place.altitude) for place in places] == [
        (12.5, 48.0, -3.0),
        (1.0, 2.0, None),
        (1.0, 2.0, 3.0),
        (1.0, 2.0, None),
        (1.0, 2.0, None),
        (1.0, 2.0, 3.0),
    ]


@pytest.mark.parametrize("name", ["IMG 2024 01 15 a.jpg", "a,b.jpg"])
def test_tables_below_a_comment_hold_any_name(tmp_path: Path, name: str) -> None:
    (tmp_path / "p").write_text(f'EPSG:4326\n# name,x,y\n"{name}",1,2\n'.replace('"', '"' if "," in name else ""))
    (source,) = with_positions([Source(Path(name), Metadata((64, 48)), Camera((64, 48)))], tmp_path / "p")
    assert source.metadata.gps == GpsPosition(2.0, 1.0)


def test_positions_that_tell_no_accuracy_get_the_one_given(tmp_path: Path) -> None:
    table = "name,lat,lon,hAcc\na.jpg,48,2,0.5\nb.jpg,48,2,\n"
    (tmp_path / "p.csv").write_text(table, encoding="utf-8")
    placed = with_positions(_sources(), tmp_path / "p.csv", accuracy=0.02)
    assert [s.metadata.gps and s.metadata.gps.std for s in placed] == [(0.5, 1.0), (0.02, 0.04), None]


@pytest.mark.parametrize(
    "text",
    [
        "1\t3521.1\t[2270]\t1,N\t-3,E\t1,V\t146.779,Lat\t6.657,Lon\t550.1,Ellh\t0.01, 0.01, 0.02\t50,Q\n",
        "1\n00:00:00,000 --> 00:00:05,000\n[latitude: 146.5] [longitude: 6.6]\n",
    ],
)
def test_degrees_that_there_are_not_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.txt").write_text(text, encoding="utf-8")
    sources = [replace(s, path=Path("DJI_0001.JPG"), metadata=replace(s.metadata, timestamp=0.0)) for s in _sources()]
    with pytest.raises(InputError, match=r"p\.txt: expected latitude and longitude in degrees, not 146"):
        with_positions(sources[:1], tmp_path / "p.txt")


def test_every_kind_of_table_tells_images_of_one_name_in_two_folders(tmp_path: Path) -> None:
    for folder in ("100", "101"):
        (tmp_path / folder).mkdir()
        Image.new("L", (32, 24)).save(tmp_path / folder / "x y.png")
    files = [tmp_path / folder / "x y.png" for folder in ("100", "101")]
    texts = {
        "positions": "SourceFile,lat,lon\n/card/101/x y.png,1,101\n/card/100/x y.png,1,100\n",
        "attitudes": "name,psi,theta\n101/x y.png,1,0\n100/x y.png,2,0\n",
        "times": "101 101/x y.png\n100 100/x y.png\n",
        "control": "EPSG:32632\n500000 5000000 0 10 20 101/x y.png P 1\n500000 5000000 0 5 6 100/x y.png\n",
        "places": "# Fiji\n100/x y.png; ; (1, 2)\n101/x y.png; ; (31, 2)\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    sources, _ = read_sources(with_times(find_images(files).frames, tmp_path / "times"), skip_bad=False)
    sources = with_attitudes(with_positions(sources, tmp_path / "positions"), tmp_path / "attitudes")
    sources = with_ground_control(sources, tmp_path / "control")
    assert [s.metadata.gps.longitude for s in sources] == [100, 101]
    assert [s.attitude.tilt[0] for s in sources] == pytest.approx(np.radians([2.0, 1.0]))
    assert timestamps_of(sources).tolist() == [100, 101]
    assert [[(c.name, c.pixel) for c in s.control] for s in sources] == [
        [("500000 5000000", (5.0, 6.0))],
        [("P 1", (10.0, 20.0))],
    ]
    places = grid_from_table([source.name for source in sources], tmp_path / "places", (32, 24), None).places
    assert (places[1] - places[0]).tolist() == [30, 0]


@pytest.mark.parametrize("check", [False, True])
def test_a_control_point_has_one_place(tmp_path: Path, check: bool) -> None:
    rows = "500000 5300000 5 30 20 a.jpg corner\n500000.0004 5300000 5 30 20 b.jpg corner\n"
    (tmp_path / "gcp").write_text(f"EPSG:32632\n{rows}", encoding="utf-8")
    assert len(with_ground_control(_sources(), tmp_path / "gcp", check=check)[1].control) == 1
    (tmp_path / "gcp").write_text(f"EPSG:32632\n{rows}500300 5300000 5 30 20 c.jpg corner\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"gcp: line 4: corner is 300 m from where it is by .*gcp: line 2"):
        with_ground_control(_sources(), tmp_path / "gcp", check=check)
