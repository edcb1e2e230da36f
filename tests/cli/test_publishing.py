"""An image and all that belongs to it: whatever fails, every file is whole, and nothing is left over or lost."""

import json
import shutil
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rdstitch.io.read import read_image
from tests.cli.running import CACHED, FAST, Run, copied, finished, sidecar_of, start
from tests.faults import OPERATIONS, Operation, failing_disk
from tests.sampled import sampled


@pytest.fixture(scope="module")
def located(frames: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three images with positions, in ``flight``, and the sidecar of their mosaic, ``field.tif.json``."""
    from rdstitch_cli.main import run

    folder = tmp_path_factory.mktemp("located")
    (folder / "flight").mkdir()
    for number, frame in enumerate(frames):
        with Image.open(frame) as image:
            exif = Image.Exif()
            exif[0x8825] = {1: "N", 2: (45.0, 0.0, 0.0), 3: "E", 4: (9.0, 0.0, 0.1 * number)}
            image.convert("RGB").save(folder / "flight" / f"{frame.stem}.jpg", exif=exif, quality=95)
    assert run(["mosaic", str(folder / "flight"), "-o", str(folder / "field.tif"), *CACHED]) == 0
    return folder


def _outputs(folder: Path) -> dict[str, bytes]:
    """Every file with its content, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _restore(folder: Path, files: dict[str, bytes]) -> None:
    shutil.rmtree(folder)
    folder.mkdir()
    for path, content in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(content)


@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize(("name", "overwrite"), sampled([("out.dzi", True), ("out.jpg", False), ("out.tif", True)]))
def test_whatever_fails(
    rdstitch: Run, located: Path, tmp_path: Path, operation: Operation, overwrite: bool, name: str
) -> None:
    arguments: tuple[str | Path, ...] = ("apply", located / "field.tif.json", "--images", located / "flight")
    arguments = (*arguments, "-o", tmp_path / name, "--scale", "0.3", "--blend", "none", "--seam", "none", "-j", "1")
    before: dict[str, bytes] = {}
    if overwrite:
        arguments = (*arguments, "--overwrite")
        rdstitch(*arguments, "--rotate", "90")
        before = _outputs(tmp_path)
    with failing_disk(operation) as disk:
        rdstitch(*arguments)
    after = _outputs(tmp_path)
    assert len(after) >= 2
    assert disk.count > 0
    # The writes of tiles and strips are many, and alike.
    for failing in range(0, disk.count, 5 if operation == "write" else 3):
        _restore(tmp_path, before)
        with failing_disk(operation, failing):
            done = rdstitch(*arguments, status=None)
        left = _outputs(tmp_path)
        if done.status == 0 and operation == "rename" and not overwrite:
            # Where a link fails, a renaming does.
            assert left == after
            continue
        assert done.status == 6, (failing, done.err)
        assert str(tmp_path) in done.line
        assert left == before or operation == "rename"
        assert not overwrite or {name, f"{name}.json"} <= set(left)
        assert all(content in (before.get(path), after.get(path)) for path, content in left.items())
    rdstitch(*arguments, "--overwrite")
    assert _outputs(tmp_path) == after


_KILLED_WHILE_PUBLISHING = """
import os, signal
from rdstitch.system.outputs import Outputs
from rdstitch_cli.main import main
place, left = Outputs._place, [{published}]
def publish(outputs, item):
    if not left[0]:
        os.kill(os.getpid(), signal.SIGKILL)
    left[0] -= 1
    place(outputs, item)
Outputs._place = publish
main()
"""


@pytest.mark.parametrize("published", sampled([1, 0]))
def test_killed_while_it_published(rdstitch: Run, frames: list[Path], tmp_path: Path, published: int) -> None:
    output, report = tmp_path / "out.png", tmp_path / "why.html"
    arguments: tuple[str | Path, ...] = ("mosaic", *frames, "-o", output, "--report", report, "--overwrite", *CACHED)
    killed = finished(start(*arguments, program=_KILLED_WHILE_PUBLISHING.format(published=published)))
    assert killed.status == -9
    assert (output.exists(), report.exists()) == (published > 0, published > 1)
    assert not (tmp_path / "out.png.json").exists()
    rdstitch(*arguments)
    assert [image["name"] for image in sidecar_of(tmp_path / "out.png")["images"]] == [frame.name for frame in frames]
    assert {path.name for path in tmp_path.iterdir()} == {"out.png", "out.png.json", "why.html"}


def test_of_two_processes_one_succeeds(located: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.dzi"
    options = (("--rotate", "0"), ("--rotate", "90"))
    arguments = ("apply", located / "field.tif.json", "--images", located / "flight", "-o", output, "-j", "1")
    running = [start(*arguments, *option) for option in options]
    done = [finished(process) for process in running]
    assert sorted(one.status for one in done) == [0, 6]
    (failed,) = (one for one in done if one.status)
    assert "exists already" in failed.line
    record = sidecar_of(tmp_path / "out.dzi")
    assert record["options"]["composite"]["rotate"] == (0, 90)[next(k for k, one in enumerate(done) if not one.status)]
    files = [tmp_path / "out.dzi", *sorted((tmp_path / "out_files").rglob("*.jpg"))]
    names = [".dzi", *(file.relative_to(tmp_path / "out_files").as_posix() for file in files[1:])]
    digests = (sha256(file.read_bytes()).hexdigest() for file in files)
    listing = "".join(f"{digest}  {name}\n" for digest, name in zip(digests, names, strict=True))
    assert record["output"]["sha256"] == sha256(listing.encode()).hexdigest()
    assert record["output"]["bytes"] == sum(file.stat().st_size for file in files)


def test_the_sidecar_names_what_it_belongs_to(rdstitch: Run, located: Path, tmp_path: Path) -> None:
    image, sidecar = (Path(shutil.copy(located / name, tmp_path)) for name in ("field.tif", "field.tif.json"))
    record = json.loads(sidecar.read_text(encoding="utf-8"))["output"]
    assert record["sha256"] == sha256(image.read_bytes()).hexdigest()
    assert record["bytes"] == image.stat().st_size
    arguments = ("apply", sidecar, "--images", located / "flight", "--scale", "0.3", "-j", "1", "-o")
    assert "warning" not in rdstitch(*arguments, tmp_path / "same.jpg", "--strict").err
    image.write_bytes(image.read_bytes()[:-1] + b"x")
    rdstitch(*arguments, tmp_path / "other.jpg", told=f"{image}: is not the image that field.tif.json was written with")
    rdstitch(*arguments, tmp_path / "strict.jpg", "--strict", status=3, told=str(image))
    image.unlink()
    assert "warning" not in rdstitch(*arguments, tmp_path / "alone.jpg", "--strict").err


def test_an_image_beside_any_sidecar_does_not_vanish(rdstitch: Run, located: Path, tmp_path: Path) -> None:
    flight = tmp_path / "flight"
    shutil.copytree(located / "flight", flight)
    first = sorted(flight.iterdir())[0]
    shutil.copy(located / "field.tif.json", f"{first}.json")
    done = rdstitch("mosaic", flight, "-o", tmp_path / "out.tif", *CACHED)
    assert (done.status, "warning" in done.err) == (0, False)
    assert len(sidecar_of(tmp_path / "out.tif")["images"]) == 3
    # What rdstitch wrote itself is no input of the next run, and that is said.
    own = [located / name for name in ("field.tif", "field.tif.json")]
    copied(own, flight)
    rdstitch("mosaic", flight, "-o", tmp_path / "again.tif", *CACHED, told="rdstitch wrote them: field.tif")
    assert read_image(tmp_path / "again.tif").pixels.shape == read_image(tmp_path / "out.tif").pixels.shape
    copied(own, tmp_path / "only")
    told = "no images but those that rdstitch wrote"
    rdstitch("mosaic", tmp_path / "only", "-o", tmp_path / "x.tif", status=3, told=told)


@pytest.mark.parametrize("name", ["frame_0001.jpg", "../flight/frame_0001.jpg"])
def test_an_image_of_the_folder_is_never_replaced(rdstitch: Run, located: Path, tmp_path: Path, name: str) -> None:
    """An output in the folder of the input is an earlier one only if rdstitch wrote it."""
    flight = tmp_path / "flight"
    shutil.copytree(located / "flight", flight)
    first = sorted(flight.iterdir())[1]
    before, output = first.read_bytes(), flight / name.replace("frame_0001.jpg", first.name)
    rdstitch("mosaic", flight, "-o", output, "--overwrite", *CACHED, status=6, told="is read as input")
    assert first.read_bytes() == before
    # What rdstitch wrote there is replaced.
    rdstitch("mosaic", flight, "-o", flight / "out.jpg", *CACHED)
    rdstitch("mosaic", flight, "-o", flight / "out.jpg", "--overwrite", *CACHED)


@pytest.mark.parametrize(
    ("made_by", "name"),
    [
        ("rdstitch.report.page.report_page", "report.html"),
        ("rdstitch.pipeline.outputs.viewer_pages.viewer_page", "field.html"),
        ("rdstitch.camera_files.camera_file_text", "camera.json"),
        ("rdstitch.georeferencing.georeference.Georeference.world_file_texts", "field.jgw"),
    ],
)
def test_what_belongs_beside_an_image_never_costs_the_image(
    made_by: str, name: str, rdstitch: Run, located: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ValueError("drawn wrongly")

    monkeypatch.setattr(made_by, fail)
    output = tmp_path / ("field.jpg" if name.endswith(".jgw") else "field.dzi")
    rdstitch(
        *("mosaic", located / "flight", "-o", output, *FAST, "--report", tmp_path / "report.html"),
        *("--save-camera", tmp_path / "camera.json"),
        told=f"{name}: not written, all else is: ValueError: drawn wrongly",
    )
    expected = {"report.html", "camera.json", output.name, f"{output.name}.json"}
    expected |= {"field.html", "field_files"} if output.suffix == ".dzi" else set()
    assert {file.name for file in tmp_path.iterdir()} == expected - {name}
    assert sidecar_of(output)["images"]


def test_an_earlier_page_is_older(
    rdstitch: Run, located: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ("mosaic", located / "flight", "-o", tmp_path / "field.dzi", *FAST, "--overwrite")
    rdstitch(*arguments)
    monkeypatch.setattr("rdstitch.pipeline.outputs.viewer_pages.viewer_page", lambda *_: 1 // 0)
    assert "the file of this name is older" in rdstitch(*arguments).err


def test_without_georeference_no_place_is_written_or_asked_for(rdstitch: Run, located: Path, tmp_path: Path) -> None:
    (tmp_path / "field.jgw").write_text("mine")
    arguments = ("mosaic", located / "flight", "-o", tmp_path / "field.jpg", "--georeference", "off", *CACHED)
    rdstitch(*arguments, "--gsd", "0.1", status=2, told="gsd needs a georeferenced output, but georeference is off")
    rdstitch(*arguments, "--poses", tmp_path / "p.csv", "--frame", "map", status=2, told="poses on the map need")
    rdstitch(*arguments)
    assert (tmp_path / "field.jgw").read_text() == "mine"


def test_a_map_that_cannot_be_made_leaves_nothing(
    rdstitch: Run, located: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rdstitch.export.map_server._pixel_to_metres", lambda *_: 1 // 0)
    arguments = ("mosaic", located / "flight", "-o", tmp_path / "field.png", *FAST)
    done = rdstitch(*arguments, "--map-server", tmp_path / "map", "--height", "9", told="map: not written")
    assert "is older" not in done.err
    assert not (tmp_path / "map").exists()


def test_layers_lie_where_the_output_does(rdstitch: Run, located: Path, tmp_path: Path) -> None:
    import rasterio

    rdstitch("mosaic", located / "flight", "-o", tmp_path / "field.tif", "--layers", tmp_path / "layers", *CACHED)
    with rasterio.open(tmp_path / "field.tif") as output:
        for layer in (tmp_path / "layers").iterdir():
            with rasterio.open(layer) as image, Image.open(layer) as file:
                assert image.crs == output.crs
                # TIFF's own positions, as enblend reads them.
                tags = dict(file.getexif())
                at = [round(float(tags[tag]) * float(tags[282])) for tag in (287, 286)]
                np.testing.assert_allclose(image.xy(0, 0), output.xy(*at), atol=1e-4)
