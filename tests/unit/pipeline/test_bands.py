"""Another band by the registration of a first one: which image belongs where, and what its lens is."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import tifffile

from rdstitch.compositing import CompositeOptions
from rdstitch.errors import ArgumentError, InputError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.crs import Crs
from rdstitch.georeferencing.map_grid import read_grid
from rdstitch.inputs.find import find_images
from rdstitch.options.apply_options import ApplyOptions
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.apply_sidecar import apply
from rdstitch.pipeline.bands import mosaic_bands
from rdstitch.pipeline.outputs.output_files import file_of_part
from rdstitch.pipeline.recipes import mosaic
from rdstitch.sidecar.read import mismatch_with_image, read_sidecar
from tests.cli.running import flight, sidecar_of

_SHIFT = np.array([-7.0, 9.0])
_NAMES = [f"IMG_{k:04d}_{{}}.png" for k in (3, 4, 7, 8, 11, 12)]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders red/ and nir/, the latter by a lens beside the first one and with reversed contrast, and red.tif."""
    folder = tmp_path_factory.mktemp("rig")
    red = flight(7, 3, 2)
    assert isinstance(red.lens, Camera)
    center = np.array(red.lens.center) + _SHIFT
    nir = replace(red, lens=replace(red.lens, focal=382.0, center=(float(center[0]), float(center[1]))))
    place = Crs(32733)
    rows = ["name,lat,lon"]
    for name, sequence in (("red", red), ("nir", nir)):
        (folder / name).mkdir()
        for k, pattern in enumerate(_NAMES):
            frame = sequence.frame(k)
            file = folder / name / pattern.format(name.upper())
            cv2.imwrite(str(file), frame if name == "red" else 255 - frame[..., 1] // 2)
            x, y = red.poses.position[k] * 0.05
            ((latitude, longitude),) = place.geographic([(500_000.0 + x, 7_000_000.0 - y)])
            rows.append(f"{file.name},{latitude:.10f},{longitude:.10f}")
    (folder / "p.csv").write_text("\n".join(rows), encoding="utf-8")
    options = StitchOptions(workers=1, positions=folder / "p.csv")
    mosaic([folder / "red"], folder / "red.tif", options)
    return folder


def _shift_between(first: Path, second: Path) -> float:
    """Median distance between what two files show, pixels."""
    with rasterio.open(first) as one, rasterio.open(second) as two:
        assert (one.transform, one.shape, one.crs) == (two.transform, two.shape, two.crs)
        bands = [opened.read(1).astype(np.float32) for opened in (one, two)]
    steep = [np.hypot(cv2.Sobel(band, cv2.CV_32F, 1, 0), cv2.Sobel(band, cv2.CV_32F, 0, 1)) for band in bands]
    window, side, shifts = cv2.createHanningWindow((96, 96), cv2.CV_32F), 96, []
    for y in range(60, steep[0].shape[0] - side - 60, side):
        for x in range(60, steep[0].shape[1] - side - 60, side):
            parts = [np.log1p(each[y : y + side, x : x + side]) for each in steep]
            shifts.append(cv2.phaseCorrelate(parts[0] - parts[0].mean(), parts[1] - parts[1].mean(), window)[0])
    return float(np.median(np.linalg.norm(shifts, axis=1)))


@pytest.mark.parametrize(
    "bands", [{}, {"a": "*"}, {"a": "*", "": "*"}, {"a": "*", "b": ""}, {"a/b": "*", "c": "*.png"}]
)
def test_bands_without_names_or_patterns_are_refused(tmp_path: Path, bands: dict[str, str]) -> None:
    with pytest.raises(ArgumentError, match="patterns by two names or more"):
        mosaic_bands([tmp_path], tmp_path / "out.tif", bands)


def test_bands_of_other_bits_are_refused_by_what_they_have(tmp_path: Path) -> None:
    for name, kind in (("red", np.uint8), ("nir", np.float32)):
        for number in range(2):
            tifffile.imwrite(tmp_path / f"{number}_{name}.tif", np.zeros((48, 64), kind))
    with pytest.raises(ArgumentError, match="RED have 8 bits, those of NIR 32 bits"):
        mosaic_bands([tmp_path], tmp_path / "out.tif", {"RED": "*_red.tif", "NIR": "*_nir.tif"})


def test_a_band_by_another_lens_is_registered(rig: Path, tmp_path: Path) -> None:
    result = apply(rig / "red.tif.json", [rig / "nir"], tmp_path / "nir.tif", workers=1)
    assert result.matched == "name"
    (told,) = [message.text for message in result.messages if message.code == "band-lens"]
    assert told.startswith("11.")
    assert _shift_between(rig / "red.tif", tmp_path / "nir.tif") < 0.3
    again = apply(tmp_path / "nir.tif.json", [rig / "nir"], tmp_path / "again.tif", workers=1)
    assert not [message for message in again.messages if message.code == "band-lens"]
    assert _same_pixels(tmp_path / "nir.tif", tmp_path / "again.tif")
    assert [source.camera for source in result.sources] == list(result.placed.cameras)
    record = sidecar_of(tmp_path / "nir.tif")
    of_another = [record[name] for name in ("lambda_std", "rms_px", "tilt_deg")]
    of_another += [record["camera"][name] for name in ("lambda_std", "focal_std_px", "lens_covariance", "tilt_std_deg")]
    assert of_another + [image[name] for image in record["images"] for name in ("features", "pose")] == [None] * 19
    assert (record["lambda"], record["lambda_known"]) != (sidecar_of(rig / "red.tif")["lambda"], True)


def test_seams_of_a_sidecar_are_those_of_its_image(rig: Path, tmp_path: Path) -> None:
    smaller = CompositeOptions(scale=0.3)
    result = apply(rig / "red.tif.json", [rig / "red"], tmp_path / "small.tif", smaller, workers=1)
    assert sidecar_of(tmp_path / "small.tif")["seams"]["places"] == len(result.seams.places) > 0


@pytest.mark.parametrize("kind", ["size", "depth"])
def test_bands_that_cannot_have_one_grid_are_refused_before_the_work(rig: Path, tmp_path: Path, kind: str) -> None:
    for file in (rig / "nir").iterdir():
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(tmp_path / file.name), image[::2, ::2] if kind == "size" else image.astype(np.uint16) * 256)
    with pytest.raises(ArgumentError, match=r"bands: images of R have .*, those of N "):
        mosaic_bands([rig / "red", tmp_path], tmp_path / "f.tif", {"R": "*_red.png", "N": "*_nir.png"})
    assert not list(tmp_path.glob("f*.tif"))


def test_all_bands_of_a_rig_at_once(rig: Path, tmp_path: Path) -> None:
    options = StitchOptions(workers=1, positions=rig / "p.csv")
    bands = {"RED": "*_red.png", "NIR": "*_NIR.png"}
    first, others = mosaic_bands([rig / "red", rig / "nir"], tmp_path / "f.tif", bands, options)
    assert first.output == tmp_path / "f-RED.tif"
    assert [other.output for other in others] == [tmp_path / "f-NIR.tif"]
    assert _shift_between(tmp_path / "f-RED.tif", tmp_path / "f-NIR.tif") < 0.3
    with rasterio.open(tmp_path / "f.tif") as stack, rasterio.open(tmp_path / "f-NIR.tif") as nir:
        assert stack.descriptions == ("RED 1", "RED 2", "RED 3", "NIR", None)
        assert (stack.transform, stack.shape, stack.crs) == (nir.transform, nir.shape, nir.crs)
        valid = stack.read(5) > 0
        np.testing.assert_array_equal(stack.read(4)[valid], nir.read(1)[valid])
        assert valid[nir.dataset_mask() > 0].mean() > 0.95
        assert stack.colorinterp[-1] == rasterio.enums.ColorInterp.alpha
        assert stack.overviews(1)
    # No band is taken as input again, and all of them together no image to stitch.
    with pytest.raises(InputError, match="no images but those that rdstitch wrote"):
        find_images([tmp_path])
    assert not mismatch_with_image(read_sidecar(tmp_path / "f.tif.json"))
    with pytest.raises(ArgumentError, match="no image has a name like"):
        mosaic_bands([rig / "red"], tmp_path / "g.tif", bands, options)
    cogeo = pytest.importorskip("rio_cogeo.cogeo")
    for file in ("f.tif", "f-RED.tif", "f-NIR.tif"):
        assert cogeo.cog_validate(tmp_path / file, quiet=True) == (True, [], [])


def test_what_is_damaged_in_one_band_is_said_of_that_band_alone(rig: Path, tmp_path: Path) -> None:
    for k, name in enumerate(_NAMES):
        frame = cv2.imread(str(rig / "nir" / name.format("NIR")))
        assert frame is not None
        coded = cv2.imencode(".jpg", frame)[1].tobytes()
        content = coded.replace(coded[-300:-260], bytes(40)) if k == 1 else coded
        (tmp_path / name.format("NIR")).with_suffix(".jpg").write_bytes(content)
        cv2.imwrite(str(tmp_path / name.format("RE")), frame)
    bands = {"RED": "*_red.png", "NIR": "*_NIR.jpg", "RE": "*_RE.png"}
    _, (nir, edge) = mosaic_bands([rig / "red", tmp_path], tmp_path / "f.tif", bands, StitchOptions(workers=1))
    damaged = [[m for m in each.messages if m.code == "damaged"] for each in (nir, edge)]
    assert [len(each) for each in damaged] == [1, 0]


def test_bands_of_an_ome_tiff_are_ome_tiffs(rig: Path, tmp_path: Path) -> None:
    options = StitchOptions(workers=1, positions=rig / "p.csv")
    bands = {"RED": "*_red.png", "NIR": "*_NIR.png"}
    mosaic_bands([rig / "red", rig / "nir"], tmp_path / "f.ome.tif", bands, options)
    pages = {}
    for name in ("f.ome.tif", "f-RED.ome.tif", "f-NIR.ome.tif"):
        with tifffile.TiffFile(tmp_path / name) as tiff:
            assert tiff.is_ome
            pages[name] = tiff.series[0].asarray()
    stack = np.moveaxis(pages["f.ome.tif"], 0, -1)
    np.testing.assert_array_equal(stack[..., :3], pages["f-RED.ome.tif"])
    np.testing.assert_array_equal(stack[..., 3], pages["f-NIR.ome.tif"])
    for file in (rig / "nir").iterdir():
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        several = np.stack([image] * 5, axis=-1)
        tifffile.imwrite(tmp_path / f"{file.stem}.tif", several, photometric="minisblack", planarconfig="contig")
    with pytest.raises(ArgumentError, match="images of NIR are neither grey nor RGB"):
        mosaic_bands([rig / "red", tmp_path], tmp_path / "g.ome.tif", {"RED": "*_red.png", "NIR": "*_NIR.tif"}, options)


@pytest.mark.parametrize("name", ["f-2.tif", "f-2.ome.tif", "f-2.OME.TIFF", "a.b-2.png", "f-2.ome.zarr"])
def test_the_file_of_a_part_has_the_same_format(name: str) -> None:
    assert file_of_part(Path(name.replace("-2", "")), 2) == Path(name)


def _write_shifted(rig: Path, folder: Path) -> None:
    """The images of the second band, each shifted by something else."""
    for k, file in enumerate(sorted((rig / "nir").iterdir())):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(folder / file.name), np.roll(image, (12 * k, -9 * k), axis=(0, 1)))


def test_of_bands_of_which_one_fails_nothing_is_written(rig: Path, tmp_path: Path) -> None:
    _write_shifted(rig, tmp_path)
    inputs = set(tmp_path.iterdir())
    with pytest.raises(InputError, match="was not taken from the same place"):
        mosaic_bands([rig / "red", tmp_path], tmp_path / "f.tif", {"R": "*_red.png", "N": "*_nir.png"})
    assert set(tmp_path.iterdir()) == inputs


def test_an_image_of_two_bands_and_a_band_without_any_that_can_be_read_are_refused(rig: Path, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"IMG_0003_NIR.png fits both A=\*_N\*.png and B=\*_NIR.png"):
        mosaic_bands([rig / "red", rig / "nir"], tmp_path / "f.tif", {"A": "*_N*.png", "B": "*_NIR.png"})
    for k in range(2):
        (tmp_path / f"{k}_bad.png").write_bytes(b"x")
    for bands in ({"B": "*_bad.png", "N": "*_NIR.png"}, {"N": "*_NIR.png", "B": "*_bad.png"}):
        with pytest.raises(InputError, match=r"0_bad\.png: .*; no other image of B can be read"):
            mosaic_bands([rig / "nir", tmp_path], tmp_path / "f.tif", bands)


def test_a_lost_image_and_one_from_elsewhere_move_no_other(rig: Path, tmp_path: Path) -> None:
    files = sorted((rig / "nir").iterdir())
    stranger = tmp_path / "IMG_0099_NIR.png"
    stranger.write_bytes(files[0].read_bytes())
    result = apply(rig / "red.tif.json", [*files[:2], *files[3:], stranger], tmp_path / "nir.tif", workers=1)
    assert list(result.left_out) == [2]
    assert [Path(m.images[0]).name for m in result.messages if "no counterpart" in m.text] == [stranger.name]
    assert _shift_between(rig / "red.tif", tmp_path / "nir.tif") < 0.3
    for file in files:
        (tmp_path / file.name).write_bytes(file.read_bytes() if file is not files[3] else b"damaged")
    result = apply(rig / "red.tif.json", [tmp_path / file.name for file in files], tmp_path / "rest.tif", workers=1)
    assert list(result.left_out) == [3]


def test_images_of_other_places_are_refused(rig: Path, tmp_path: Path) -> None:
    _write_shifted(rig, tmp_path)
    with pytest.raises(InputError, match="was not taken from the same place"):
        apply(rig / "red.tif.json", [tmp_path], workers=1)
    unlike = [tmp_path / f"{word}.png" for word in ("one", "two", "three", "four", "five", "six")]
    for file, copy in zip(sorted((rig / "red").iterdir()), unlike, strict=True):
        copy.write_bytes(file.read_bytes())
    with pytest.raises(InputError, match="--match order takes them in order"):
        apply(rig / "red.tif.json", unlike, workers=1)
    with pytest.raises(ArgumentError, match="match must be one of auto, name, order, not 'guess'"):
        apply(rig / "red.tif.json", unlike, match="guess")
    in_order = apply(rig / "red.tif.json", unlike, options=ApplyOptions(match="order", dry_run=True), workers=1)
    assert in_order.matched == "order"
    assert in_order.plan is not None


def test_the_grid_of_another_file(rig: Path, tmp_path: Path) -> None:
    """An extent of the map, and the same pixels for another run; elsewhere there is nothing."""
    sidecar, files = rig / "red.tif.json", [rig / "red"]
    with rasterio.open(rig / "red.tif") as opened:
        west, south = opened.bounds.left + 5.0, opened.bounds.bottom + 5.0
    part = CompositeOptions(extent=(west, south, west + 12.0, south + 8.0), gsd=0.1)
    apply(sidecar, files, tmp_path / "part.tif", part, workers=1)
    with rasterio.open(tmp_path / "part.tif") as opened:
        assert opened.shape == (80, 120)
        assert opened.transform[:6] == (0.1, 0.0, west, 0.0, -0.1, south + 8.0)
    like = CompositeOptions(like=str(tmp_path / "part.tif"))
    apply(sidecar, files, tmp_path / "like.tif", like, workers=1)
    assert _same_pixels(tmp_path / "part.tif", tmp_path / "like.tif")
    with pytest.raises(ArgumentError, match="none of the images lies within"):
        apply(sidecar, files, options := None, replace(part, extent=(west + 5e3, south, west + 6e3, south + 9.0)))
    cv2.imwrite(str(tmp_path / "plain.tif"), np.zeros((9, 9), dtype=np.uint8))
    with pytest.raises(InputError, match="is not a GeoTIFF with square pixels"):
        apply(sidecar, files, options, CompositeOptions(like=str(tmp_path / "plain.tif")))
    keys = [(34735, 3, 5, (1, 1, 0, 1, 3072), True)]  # cut off
    tifffile.imwrite(tmp_path / "cut.tif", np.zeros((9, 9), dtype=np.uint8), extratags=keys)
    with pytest.raises(InputError, match=r"cut\.tif: is not a GeoTIFF"):
        read_grid(tmp_path / "cut.tif")


def _same_pixels(first: Path, second: Path) -> bool:
    with rasterio.open(first) as one, rasterio.open(second) as two:
        same = (one.transform, one.shape, one.crs) == (two.transform, two.shape, two.crs)
        return same and bool((one.read() == two.read()).all())
