"""Tiles as microscopes' programs write them, made here by tifffile."""

import json
from collections.abc import Iterator
from errno import EACCES
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.frame import Frame
from rdstitch.io.metadata import read_metadata
from rdstitch.io.read import read_image
from rdstitch.io.stored_tiles import stored_tiles
from rdstitch.stage.tile_inputs import tile_frames, with_position_folders

SHAPE = (12, 16)


def _planes(*counts: int) -> NDArray[np.uint16]:
    """Planes that are told apart by their value."""
    numbers = np.arange(int(np.prod(counts)), dtype=np.uint16).reshape(*counts, 1, 1)
    return np.broadcast_to(numbers, (*counts, *SHAPE)).copy()


@pytest.mark.parametrize("unit", [b"um", b"\xb5m", b"\\u00B5m"])
def test_planes_of_a_hyperstack_are_found_by_channel_z_and_time(tmp_path: Path, unit: bytes) -> None:
    file = tmp_path / "a.tif"
    tifffile.imwrite(
        file, _planes(2, 3, 4), imagej=True, metadata={"axes": "TZCYX", "unit": "X" * len(unit)}, resolution=(2.0, 2.0)
    )
    file.write_bytes(file.read_bytes().replace(b"unit=" + b"X" * len(unit), b"unit=" + unit))
    (tile,) = stored_tiles([file])
    assert (tile.counts, tile.pixel_size) == ((4, 3, 2), 0.5)
    np.testing.assert_array_equal(tile.read(1, 1)[0][0, 0], [16, 17, 18, 19])
    np.testing.assert_array_equal(tile.read("max", 0)[0][0, 0], [8, 9, 10, 11])


@pytest.mark.parametrize(("z", "time"), [(3, None), (None, 2)])
def test_planes_that_are_not_there_are_refused_by_name(tmp_path: Path, z: int | None, time: int | None) -> None:
    file = tmp_path / "a.tif"
    tifffile.imwrite(file, _planes(2, 3), imagej=True, metadata={"axes": "TZYX"})
    with pytest.raises(ArgumentError, match=r"a\.tif: has \d"):
        tile_frames([Frame(file)], z, time)
    frames, _, notes = tile_frames([Frame(file)], None, None)
    assert [frame.path for frame in frames] == [file]
    assert [message.text.partition(":")[0] for message in notes] == ["files hold 3 z planes", "files hold 2 times"]
    tifffile.imwrite(file, _planes(1, 1)[0, 0])
    with pytest.raises(ArgumentError, match=r"no file has a (z plane|time) with the number"):
        tile_frames([Frame(file)], z, time)


def _ome(images: str, uuid: str = "urn:uuid:1") -> str:
    return f'<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="{uuid}">{images}</OME>'


def _image(number: int, data: str, label: str = "") -> str:
    plane = f'<Plane TheC="0" TheZ="0" TheT="0" PositionX="{number}" PositionY="7" PositionXUnit="mm"/>'
    return (
        f'<Image ID="Image:{number}"><Pixels ID="Pixels:{number}" DimensionOrder="XYZCT" Type="uint16" SizeX="16" '
        f'SizeY="12" SizeZ="1" SizeC="2" SizeT="1" PhysicalSizeX="0.5"><Channel ID="C:0" Name="DAPI"/>'
        f'<Channel ID="C:1" Name="GFP"/>{data}{"" if label else plane}</Pixels>{label}</Image>'
    )


def test_of_a_set_each_file_is_the_image_that_names_it(tmp_path: Path) -> None:
    data = '<TiffData IFD="0" PlaneCount="2"><UUID FileName="{0}.ome.tif">urn:uuid:{0}</UUID></TiffData>'
    xml = [_ome("".join(_image(k, data.format(k)) for k in range(3)), f"urn:uuid:{n}") for n in range(3)]
    files = [tmp_path / f"{n}.ome.tif" for n in range(3)]
    for n, file in enumerate(files):
        tifffile.imwrite(file, _planes(2) + 10 * n, description=xml[n], metadata=None, photometric="minisblack")
    files.append(files[2].rename(tmp_path / "renamed.ome.tif"))
    del files[2]
    tiles = stored_tiles(files)
    assert [tile.position for tile in tiles] == [(0.0, 7.0), (1.0, 7.0), (2.0, 7.0)]
    assert {(tile.unit, tile.pixel_size, tile.channel_names) for tile in tiles} == {(1e3, 0.5, ("DAPI", "GFP"))}
    assert [tile.read(0, 0)[0][0, 0].tolist() for tile in tiles] == [[0, 1], [10, 11], [20, 21]]


@pytest.mark.parametrize("counts", ['SizeZ="1000000000"', 'SizeC="1000000000"', 'SizeC="-3"', f'SizeT="{10**40}"'])
@pytest.mark.parametrize("data", ["<TiffData/>", '<TiffData IFD="1" PlaneCount="2000000000"/>', '<TiffData IFD="9"/>'])
def test_no_more_planes_than_pages_whatever_the_header_says(tmp_path: Path, counts: str, data: str) -> None:
    told = f'SizeX="16" SizeY="12" {counts} DimensionOrder="XYZCT" Type="uint16"'
    xml = _ome(f'<Image ID="Image:0"><Pixels ID="Pixels:0" {told}>{data}</Pixels></Image>')
    file = tmp_path / "a.ome.tif"
    tifffile.imwrite(file, _planes(3), description=xml, metadata=None, photometric="minisblack")
    (tile,) = stored_tiles([file])
    assert len(tile.planes) <= 3
    assert read_image(file).pixels.shape == read_metadata(file).size[::-1] == SHAPE


def test_series_of_one_file_are_tiles_of_their_own_and_labels_say_where(tmp_path: Path) -> None:
    file = tmp_path / "all.ome.tif"
    label = '<StageLabel Name="p" X="{0}" Y="1" XUnit="µm" YUnit="µm"/>'
    images = (_image(k, f'<TiffData IFD="{2 * k}" PlaneCount="2"/>', label.format(5 * k)) for k in range(2))
    tifffile.imwrite(
        file, _planes(4), description=_ome("".join(images)).encode(), metadata=None, photometric="minisblack"
    )
    tiles = stored_tiles([file])
    assert [tile.name.name for tile in tiles] == ["all.ome.tif#0", "all.ome.tif#1"]
    assert [(tile.position, tile.unit) for tile in tiles] == [((0.0, 1.0), 1.0), ((5.0, 1.0), 1.0)]
    assert tiles[1].read(0, 0)[0][0, 0].tolist() == [2, 3]


def test_micro_manager_says_it_in_a_tag_or_beside_folders(tmp_path: Path) -> None:
    tag = {"XPositionUm": 3.0, "YPositionUm": 4.0, "PixelSizeUm": 0.65, "Channel": "GFP"}
    file = tmp_path / "one.tif"
    text = json.dumps(tag)
    tifffile.imwrite(file, _planes(1)[0], metadata=None, extratags=[(51123, 2, len(text) + 1, text, True)])
    (tile,) = stored_tiles([file])
    assert (tile.position, tile.unit, tile.pixel_size, tile.is_plain) == ((3.0, 4.0), 1.0, 0.65, True)
    root = tmp_path / "run"
    for position in range(2):
        (folder := root / f"1-Pos_{position:03d}").mkdir(parents=True)
        entries = {}
        for channel in range(2):
            name = f"img_channel{channel:03d}_z000.tif"
            tifffile.imwrite(folder / name, _planes(4)[2 * position + channel])
            about = {
                "FileName": name,
                "ChannelIndex": channel,
                "SliceIndex": 0,
                "FrameIndex": 0,
                "Channel": f"c{channel}",
            }
            entries[f"Metadata-Default/{name}"] = {**about, **tag, "XPositionUm": 10.0 * position}
        (folder / "metadata.txt").write_text(json.dumps(entries), encoding="utf-8")
    folders = with_position_folders([root])
    assert [Path(str(folder)).name for folder in folders] == ["1-Pos_000", "1-Pos_001"]
    tiles = stored_tiles(sorted(root.glob("*/*.tif")))
    assert [(tile.name.name, tile.position) for tile in tiles] == [
        ("1-Pos_000", (0.0, 4.0)),
        ("1-Pos_001", (10.0, 4.0)),
    ]
    assert tiles[1].read(0, 0)[0][0, 0].tolist() == [2, 3]


def test_metadata_that_cannot_be_read_beside_tiles_says_nothing(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    file.write_bytes(b"")
    for text in ("[" * 100_000, "[1]", '{"Metadata-a.png": 1}', "{"):
        (tmp_path / "metadata.txt").write_text(text, encoding="utf-8")
        (tile,) = stored_tiles([file])
        assert tile.is_plain
        assert tile.position is None


def test_positions_are_folders_of_what_counts_as_an_image(tmp_path: Path) -> None:
    for name in ("._b.tif", "Pos1/a.tif", "Pos2/a.dng", "Pos3/._a.tif", ".thumbnails/a.tif"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert with_position_folders([tmp_path]) == [tmp_path / "Pos1", tmp_path / "Pos2"]


def test_a_folder_of_positions_that_cannot_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "Pos1").mkdir()
    listed = Path.iterdir

    def denied(folder: Path) -> Iterator[Path]:
        if folder.name == "Pos1":
            raise PermissionError(EACCES, "Permission denied")
        return listed(folder)

    monkeypatch.setattr(Path, "iterdir", denied)
    with pytest.raises(InputError, match="Pos1: cannot read the folder: Permission denied"):
        with_position_folders([tmp_path])


def test_files_are_told_from_other_tiles_in_one_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stack = tmp_path / "stack.tif"
    tifffile.imwrite(stack, _planes(2), metadata=None)
    frames = [Frame(stack), *(Frame(tmp_path / f"{k}.png") for k in range(30))]
    compared = list[Path]()

    def counted(path: Path) -> int:
        compared.append(path)
        return hash(str(path))

    monkeypatch.setattr(Path, "__hash__", counted)
    tile_frames(frames, 0, None)
    assert len(compared) < 20 * len(frames)


def test_an_overview_beside_an_image_is_no_plane(tmp_path: Path) -> None:
    file = tmp_path / "pyramid.tif"
    with tifffile.TiffWriter(file) as tiff:
        tiff.write(_planes(1)[0], metadata=None, photometric="minisblack")
        tiff.write(_planes(1)[0, ::2, ::2], subfiletype=1, metadata=None)
    assert stored_tiles([file])[0].is_plain


def test_an_overview_between_planes_is_no_plane(tmp_path: Path) -> None:
    file = tmp_path / "pyramids.tif"
    with tifffile.TiffWriter(file) as tiff:
        for plane in _planes(3):
            tiff.write(plane, metadata=None, photometric="minisblack")
            tiff.write(plane[::2, ::2] + 10, subfiletype=1, metadata=None, photometric="minisblack")
    (tile,) = stored_tiles([file])
    assert tile.counts == (1, 3, 1)
    for z in range(3):
        np.testing.assert_array_equal(tile.read(z, 0)[0], _planes(3)[z])
