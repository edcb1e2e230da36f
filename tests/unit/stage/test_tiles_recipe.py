"""``rdstitch.tiles`` on arrays and on files that are not all alike."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

import rdstitch
from examples.worlds.stage_grid import StageGrid
from rdstitch.errors import ArgumentError, InputError, RegistrationError

STAGE = StageGrid(rows=2, columns=3, tile=256, overlap=0.2, content=0.9, backlash=2.0, seed=5)
TILES = np.stack([STAGE.render(index) for index in range(6)])


def _errors(result: rdstitch.StitchResult, wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    assert result.registration.tiles is not None
    off = result.registration.tiles.adjustment.places - wanted
    return np.asarray(np.linalg.norm(off - np.median(off, axis=0), axis=1))


class _Lazy:
    """An array of another library: it has a shape and a type, and is read when it is wanted."""

    def __init__(self, array: NDArray[np.uint16]) -> None:
        self.array, self.shape, self.dtype, self.reads = array, array.shape, array.dtype, 0

    def __array__(self, dtype: object = None, copy: object = None) -> NDArray[np.uint16]:
        self.reads += 1
        return self.array


def test_arrays_of_any_library_with_positions() -> None:
    result = rdstitch.tiles(TILES, positions=STAGE.nominal, pixel_size=0.5)
    assert _errors(result, STAGE.places).max() < 0.5
    lazy = [_Lazy(np.stack([tile, tile // 2])) for tile in TILES]
    table = {"x_um": STAGE.nominal[:, 0] / 2, "y_um": STAGE.nominal[:, 1] / 2}
    again = rdstitch.tiles(lazy, positions=table, pixel_size=0.5, channel=0)
    assert _errors(again, STAGE.places).max() < 0.5
    assert again.image.shape == (*result.image.shape[:2], 2)
    np.testing.assert_array_equal(again.image[..., 0], result.image.reshape(result.image.shape[:2]))
    assert min(item.reads for item in lazy) > 0


def test_a_lens_that_was_given_is_called_so() -> None:
    _, registration = rdstitch.place_tiles(TILES, positions=STAGE.nominal, distortion=0.01)
    assert registration.summary.endswith("λ = 0.0100 (given)")
    assert any(message.text.startswith("6 images are too few to show") for message in registration.messages)


@pytest.mark.parametrize("places", [[[1, 2], [3]], [["a", "b"]] * 6, [[0, 0]] * 7, {"x": [1] * 6, "y": [1] * 5}])
def test_positions_that_are_no_numbers_of_each_tile_are_refused(places: object) -> None:
    with pytest.raises(ArgumentError, match="numbers, x and y of each of 6 tiles"):
        rdstitch.tiles(TILES, positions=places)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("side", [1, 2, 4])
def test_tiles_of_a_few_pixels_are_refused_and_nothing_else_is_said(side: int) -> None:
    with pytest.raises(RegistrationError, match="none of"):
        rdstitch.place_tiles(TILES[:, :side, :side], positions=STAGE.nominal * side / 256)


def test_a_list_of_positions_that_is_not_there_is_told_before_a_tile_is_read(tmp_path: Path) -> None:
    lazy = [_Lazy(tile) for tile in TILES]
    with pytest.raises(InputError, match="missing"):
        rdstitch.tiles(lazy, positions=tmp_path / "missing.csv", flat_field="auto")
    assert not any(item.reads for item in lazy)


def test_a_result_of_which_most_tiles_show_nothing_is_not_ok() -> None:
    noise = np.random.default_rng(1).integers(90, 110, (4, 256, 256)).astype(TILES.dtype)
    result = rdstitch.tiles([*TILES[:2], *noise], positions=STAGE.nominal, distortion=0.0, flat_field="off")
    assert not result.ok
    assert result.verdict.failures[0].startswith("4 of 6 tiles have their places from the stage alone")
    assert rdstitch.tiles(TILES, positions=STAGE.nominal).ok


def test_one_array_of_all_tiles_is_read_tile_by_tile() -> None:
    zarr = pytest.importorskip("zarr")
    result = rdstitch.tiles(zarr.array(TILES, chunks=(1, 256, 256)), positions=STAGE.nominal)
    assert _errors(result, STAGE.places).max() < 0.5


def test_a_truncated_tile_and_a_coloured_one_are_left_out_by_name(tmp_path: Path) -> None:
    files = STAGE.write(tmp_path)
    tifffile.imwrite(files[2], np.repeat(TILES[2][..., None], 3, axis=2), photometric="rgb")
    files[5].write_bytes(files[5].read_bytes()[:60_000])
    result = rdstitch.tiles(tmp_path, grid="r{row}c{col}", overlap=20.0)
    assert sorted(Path(message.images[0]).name for message in result.registration.left_out) == [
        "r00c02.tif",
        "r01c02.tif",
    ]
    assert _errors(result, STAGE.places[[0, 1, 3, 4]]).max() < 0.5
    with pytest.raises(InputError, match="r0"):
        rdstitch.tiles(tmp_path, grid="r{row}c{col}", overlap=20.0, strict=True)


@pytest.mark.parametrize("by", ["array", "table", "names", "numbers"])
@pytest.mark.parametrize("lost", [0, 2, 5])
def test_a_tile_that_cannot_be_read_moves_no_other(tmp_path: Path, by: str, lost: int) -> None:
    files = STAGE.write(tmp_path)
    named: dict[str, Any] = {"positions": STAGE.nominal} if by == "array" else {"positions": tmp_path / "positions.csv"}
    if by in ("names", "numbers"):
        named = {"overlap": 20.0, "grid": "r{row}c{col}"}
    if by == "numbers":
        files = [file.rename(tmp_path / f"img_{k}.tif") for k, file in enumerate(files)]
        named |= {"grid": "img_{number}", "columns": 3}
    kept = [k for k in range(6) if k != lost]
    files[lost].write_bytes(b"II*\0")
    (_, registration) = found = rdstitch.place_tiles(files, **named)
    assert [Path(message.images[0]) for message in registration.left_out] == [files[lost]]
    off = found[0].grid.places - STAGE.nominal[kept]
    np.testing.assert_allclose(off, np.broadcast_to(off[0], off.shape), atol=2.0)


@pytest.mark.parametrize("columns", [3, 4])
def test_columns_that_the_tiles_contradict_are_told(tmp_path: Path, columns: int) -> None:
    stage = replace(STAGE, rows=3)
    order = [*range(3), *range(5, 2, -1), *range(6, 9)]  # a snake
    for number, k in enumerate(order):
        tifffile.imwrite(tmp_path / f"img_{number}.tif", stage.render(k))
    scan: dict[str, Any] = {"grid": "img_{number}", "columns": columns, "order": "snake-rows", "overlap": 20.0}
    _, registration = rdstitch.place_tiles(tmp_path, **scan)
    told = [message.text for message in registration.messages if message.code == "grid-as-shown"]
    assert len(told) == (columns == 4)
    assert columns == 3 or "overlaps, as that of img_2.tif and img_3.tif, are not where it has them" in told[0]


def test_tiles_of_several_sizes_lie_where_they_are(tmp_path: Path) -> None:
    files = STAGE.write(tmp_path)
    tifffile.imwrite(files[4], TILES[4][:230, :250])
    result = rdstitch.tiles(tmp_path, positions=tmp_path / "positions.csv")
    assert _errors(result, STAGE.places).max() < 0.5
    assert result.registration.tiles is not None
    assert result.registration.tiles.linked.all()
    mosaic = result.image.reshape(result.image.shape[:2])
    places = result.registration.tiles.adjustment.places
    x, y = np.rint(places[4] - places.min(axis=0)).astype(int) + 80
    near = [mosaic[y + v : y + v + 60, x + u : x + u + 60] for v in (-1, 0, 1) for u in (-1, 0, 1)]
    assert any(np.array_equal(part, TILES[4][80:140, 80:140]) for part in near)
    _, registration = rdstitch.place_tiles(tmp_path, positions=tmp_path / "positions.csv", distortion=0.0)
    assert registration.summary.endswith("λ = 0.0000 (given)")
    with pytest.raises(ArgumentError, match="neither a flat field nor a lens in common"):
        rdstitch.place_tiles(tmp_path, positions=tmp_path / "positions.csv", distortion=0.01)
    with pytest.raises(ArgumentError, match="tiles of different sizes do not show λ"):
        rdstitch.tiles(tmp_path, positions=tmp_path / "positions.csv", distortion="auto")


def test_another_channel_keeps_the_frame_whatever_tiles_it_lacks(tmp_path: Path) -> None:
    files = STAGE.write(tmp_path / "a")
    rdstitch.tiles(tmp_path / "a", tmp_path / "a.ome.tif", grid="r{row}c{col}", overlap=20.0, pixel_size=0.65)
    (tmp_path / "b").mkdir()
    for file in files[1:]:
        tifffile.imwrite(tmp_path / "b" / file.name, tifffile.imread(file) // 2)
    rdstitch.apply(tmp_path / "a.ome.tif.json", tmp_path / "b", tmp_path / "b.ome.tif")
    with tifffile.TiffFile(tmp_path / "a.ome.tif") as one, tifffile.TiffFile(tmp_path / "b.ome.tif") as two:
        first, second = one.asarray(), two.asarray()
        assert 'PhysicalSizeX="0.65"' in str(two.ome_metadata)
    assert first.shape == second.shape
    # Where the tile is missing its neighbours reach farther.
    same = second[second > 0] == first[second > 0] // 2
    assert 0.9 < same.mean() < 1.0


def test_all_channels_go_into_one_ome_zarr(tmp_path: Path) -> None:
    zarr = pytest.importorskip("zarr")
    folder = tmp_path / "tiles"
    folder.mkdir()
    for index, tile in enumerate(TILES):
        metadata = {
            "axes": "CYX",
            "Channel": {"Name": ["DAPI", "GFP"]},
            "PhysicalSizeX": 0.5,
            "PhysicalSizeXUnit": "µm",
        }
        metadata["Plane"] = {f"Position{axis}": [STAGE.nominal[index, k] / 2] * 2 for k, axis in enumerate("XY")}
        tifffile.imwrite(folder / f"{index}.ome.tif", np.stack([tile, tile // 2]), metadata=metadata)
    output = tmp_path / "all.ome.zarr"
    rdstitch.tiles(folder, output, channel=0)
    group = zarr.open_group(output, mode="r")
    about = dict(group.attrs)
    assert [channel["label"] for channel in about["omero"]["channels"]] == ["DAPI", "GFP"]
    assert about["multiscales"][0]["datasets"][0]["coordinateTransformations"][0]["scale"] == [1.0, 0.5, 0.5]
    image = group["0"][:]
    np.testing.assert_array_equal(image[1], image[0] // 2)
    rdstitch.tiles(folder, tmp_path / "all.ome.tif", channel=0)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "all.ome.tif"), image)
    rdstitch.tiles(folder, output, channel=0, overwrite=True)
