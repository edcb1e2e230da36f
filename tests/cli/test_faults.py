"""Bad input, bad output, bad luck: one line, the right status, nothing lost, nothing half-written."""

import errno
import json
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image
from rdstitch_cli.main import run

from rdstitch.inputs import source as sources
from rdstitch.io import Metadata, read_image, read_metadata
from rdstitch.pipeline import accept, recipes
from rdstitch.verification.verdict import judge
from tests.cli.faulty import UNREADABLE, UNUSABLE, Make
from tests.cli.running import DISTORTION, FAST, Outcome, Run, finished, start


@pytest.fixture
def place(tmp_path: Path, frames: list[Path]) -> Path:
    """A folder with two good pictures, ``a.png`` and ``b.png``."""
    for name, frame in zip("ab", frames[:2], strict=True):
        shutil.copy(frame, tmp_path / f"{name}.png")
    return tmp_path


def _state(folder: Path) -> dict[str, bytes | None]:
    """Every file with its content."""
    return {
        os.fsencode(path.relative_to(folder)).decode("latin-1"): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def _shown(path: Path) -> str:
    """A name as it appears within a line."""
    return str(path).encode("utf-8", "backslashreplace").decode("utf-8").replace("\n", " ")


def _refused(done: Outcome, status: int, named: Path | str) -> None:
    """Status, and one line that says which file."""
    assert done.status == status, done.err
    assert done.out == ""
    assert done.line.startswith("rdstitch: ")
    assert _shown(Path(named)) in done.line


@pytest.mark.parametrize("make", UNREADABLE.values(), ids=UNREADABLE.keys())
def test_unreadable_pictures(rdstitch: Run, place: Path, make: Make) -> None:
    bad = make(place / "b.png", place)
    before = _state(place)
    done = rdstitch("pano", "-o", place / "out.png", *FAST, place / "a.png", bad)
    _refused(done, 3, bad)
    assert _state(place) == before


@pytest.mark.parametrize("make", UNUSABLE.values(), ids=UNUSABLE.keys())
def test_pictures_that_fit_to_nothing(rdstitch: Run, place: Path, make: Make) -> None:
    bad = make(place / "b.png", place)
    before = _state(place)
    done = rdstitch("pano", place / "a.png", bad, "-o", place / "out.png", *FAST)
    _refused(done, 4, bad.name)
    assert _state(place) == before


@pytest.mark.parametrize("kind", ["missing", "name that is not UTF-8", "JPEG cut at 50%", "one pixel", "black"])
def test_a_mosaic_leaves_them_out_by_name(rdstitch: Run, place: Path, kind: str) -> None:
    bad = {**UNREADABLE, **UNUSABLE}[kind](place / "b.png", place)
    done = rdstitch("mosaic", place / "a.png", place / "b.png", bad, "-o", place / "out.jpg", *FAST)
    assert done.status == 0, done.err
    assert _shown(bad) in done.line
    assert (place / "out.jpg").stat().st_size > 1000


def _saved(good: Path, file: Path, change: Callable[[Image.Image], Image.Image], **options: Any) -> Path:
    with Image.open(good) as image:
        change(image).save(file, **options)
    return file


def _cmyk(good: Path, folder: Path) -> Path:
    return _saved(good, folder / "odd.jpg", lambda image: image.convert("CMYK"))


def _palette(good: Path, folder: Path) -> Path:
    return _saved(good, folder / "odd.png", lambda image: image.quantize(200))


def _transparent(good: Path, folder: Path) -> Path:
    def change(image: Image.Image) -> Image.Image:
        image.putalpha(Image.fromarray(np.where(np.indices((300, 400))[0] < 20, 0, 255).astype(np.uint8)))
        return image

    return _saved(good, folder / "odd.png", change)


def _grey(good: Path, folder: Path) -> Path:
    return _saved(good, folder / "odd.png", lambda image: image.convert("L"))


def _turned(good: Path, folder: Path) -> Path:
    exif = Image.Exif()
    exif[0x0112] = 6
    return _saved(good, folder / "odd.jpg", lambda image: image.transpose(Image.Transpose.ROTATE_90), exif=exif)


def _with_a_hole(good: Path, folder: Path) -> Path:
    """Floating-point samples, some of them NaN."""
    for name in "ab":
        samples = read_image(folder / f"{name}.png").pixels.astype(np.float32) / 255.0
        samples[:30, :50] = np.nan
        tifffile.imwrite(folder / f"{name}.tif", samples, photometric="rgb")
    (folder / "a.tif").rename(folder / "a.png")
    return folder / "b.tif"


def _sixteen_bit(good: Path, folder: Path) -> Path:
    for name in "ab":
        deep = read_image(folder / f"{name}.png").pixels.astype(np.uint16) * 257
        assert cv2.imwrite(str(folder / f"{name}.png"), deep[..., ::-1])
    return folder / "b.png"


def _hostile_exif(good: Path, folder: Path) -> Path:
    exif = Image.Exif()
    exif[0x010F] = "\x1b[31m" * 500
    exif[0x8769] = {0x920A: (0, 0)}
    return _saved(good, folder / "odd.jpg", lambda image: image, exif=exif)


@pytest.mark.parametrize(
    "make", [_cmyk, _palette, _transparent, _grey, _turned, _with_a_hole, _sixteen_bit, _hostile_exif]
)
def test_unusual_pictures_are_stitched(rdstitch: Run, place: Path, make: Make) -> None:
    odd = make(place / "b.png", place)
    done = rdstitch("pano", place / "a.png", odd, "-o", place / "out.tif", *FAST)
    assert (done.status, done.err) == (0, "")
    assert abs(float(done.out) - DISTORTION) < 0.02
    record = json.loads((place / "out.tif.json").read_text(encoding="utf-8"))
    assert all(image["used"] for image in record["images"])
    assert [image["size"] for image in record["images"]] == [[400, 300]] * 2


def test_samples_of_two_kinds_are_refused(rdstitch: Run, place: Path) -> None:
    deep = place / "deep.png"
    assert cv2.imwrite(str(deep), read_image(place / "b.png").pixels.astype(np.uint16) * 257)
    done = rdstitch("pano", place / "a.png", deep, "-o", place / "out.png", *FAST)
    _refused(done, 3, deep)
    assert not (place / "out.png").exists()


@pytest.mark.parametrize(
    "name",
    [
        "a b.png",
        "it's.png",
        'say "x".png',
        "two\nlines.png",
        os.fsdecode(b"caf\xe9.png"),
        "-o.png",
        "[1]*.png",
        "π.png",
    ],
)
def test_odd_names_work(place: Path, name: str) -> None:
    picture, output = place / name, place / f"out {name}"
    (place / "b.png").rename(picture)
    done = finished(start("pano", place / "a.png", picture, "-o", output, *FAST))
    assert (done.status, done.err) == (0, "")
    assert output.exists()
    record = json.loads(Path(f"{output}.json").read_text(encoding="utf-8"))
    assert len(record["images"]) == 2


def test_one_picture_or_the_same_twice(rdstitch: Run, place: Path) -> None:
    (place / "link.png").symlink_to("a.png")
    for pictures in (["a.png"], ["a.png", "a.png"], ["a.png", "link.png"]):
        done = rdstitch("pano", *(place / name for name in pictures), "-o", place / "out.png", *FAST)
        assert done.status == 2
        assert "two different pictures" in done.line


def test_no_overlap(rdstitch: Run, place: Path, stranger: Path) -> None:
    before = _state(place)
    done = rdstitch("pano", place / "a.png", stranger, "-o", place / "out.png", *FAST)
    _refused(done, 4, stranger.name)
    assert _state(place) == before


@pytest.mark.parametrize("name", ["empty", "nothing", "missing.txt", "*.nothing"])
def test_inputs_that_name_nothing(rdstitch: Run, place: Path, name: str) -> None:
    (place / "empty").mkdir()
    (place / "nothing").mkdir()
    (place / "nothing" / "notes.txt").write_text("no pictures", encoding="utf-8")
    named = f"@{place / name}" if name.endswith(".txt") else str(place / name)
    _refused(rdstitch("mosaic", named, "-o", place / "out.png", *FAST), 3, place / name)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "text",
        "[]",
        "null",
        "{}",
        '{"format": "rdstitch camera", "version": 99}',
        '{"format": "rdstitch camera", "version": 1, "image_size": [400, 300], "center_px": [1, 2], "lambda": NaN}',
        '{"format": "rdstitch camera", "version": 1, "image_size": [400, 300], "center_px": [1, 2], "lambda": 5}',
        '{"format": "rdstitch camera", "version": 1, "image_size": [1e400, 3], "center_px": [1, 2], "lambda": 0}',
        '{"format": "rdstitch camera", "version": 1, "image_size": "wide", "center_px": [1, 2], "lambda": 0}',
        "\udcff\udcfe",
        "[" * 100000,
    ],
)
def test_camera_files_that_are_none(rdstitch: Run, place: Path, content: str) -> None:
    file = place / "camera.json"
    file.write_bytes(content.encode("utf-8", "surrogateescape"))
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", "--camera", file, *FAST)
    _refused(done, 3, file)


def _exists(place: Path) -> Path:
    (place / "out.png").write_bytes(b"mine")
    return place / "out.png"


def _sidecar_exists(place: Path) -> Path:
    (place / "out.png.json").write_bytes(b"mine")
    return place / "out.png"


def _is_input(place: Path) -> Path:
    return place / "a.png"


def _links_to_input(place: Path) -> Path:
    (place / "link.png").symlink_to("a.png")
    return place / "link.png"


def _is_folder(place: Path) -> Path:
    (place / "out.png").mkdir()
    return place / "out.png"


def _sidecar_is_folder(place: Path) -> Path:
    (place / "out.png.json").mkdir()
    return place / "out.png"


def _no_folder(place: Path) -> Path:
    return place / "missing" / "out.png"


def _under_a_file(place: Path) -> Path:
    return place / "a.png" / "out.png"


def _unknown_type(place: Path) -> Path:
    return place / "out.xyz"


def _no_type(place: Path) -> Path:
    return place / "out"


def _too_long(place: Path) -> Path:
    return place / ("x" * 300 + ".png")


@pytest.mark.parametrize(
    "make",
    [
        *(_exists, _sidecar_exists, _is_input, _links_to_input, _is_folder, _sidecar_is_folder, _no_folder),
        *(_under_a_file, _unknown_type, _no_type, _too_long),
    ],
)
@pytest.mark.parametrize("command", ["pano", "mosaic"])
def test_outputs_that_cannot_be(rdstitch: Run, place: Path, make: Callable[[Path], Path], command: str) -> None:
    output = make(place)
    before = _state(place)
    done = rdstitch(command, place / "a.png", place / "b.png", "-o", output, *FAST)
    _refused(done, 6, output)
    assert _state(place) == before
    if make in (_is_input, _links_to_input):
        done = rdstitch(command, place / "a.png", place / "b.png", "-o", output, "--overwrite", *FAST)
        _refused(done, 6, output)
        assert _state(place) == before


def test_a_folder_that_may_not_be_written(rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Simulated: the superuser, under whom tests may run, may write everywhere.
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK and allowed(path, mode))
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *FAST)
    _refused(done, 6, place / "out.png")


def test_a_picture_that_may_not_be_read(rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "b.png" and allowed(path, mode))
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *FAST)
    _refused(done, 3, place / "b.png")


@pytest.mark.parametrize("command", ["pano", "calibrate", "trajectory", "undistort"])
def test_a_full_disk(place: Path, command: str) -> None:
    output = place / {"pano": "out.png", "calibrate": "out.json", "trajectory": "out.csv", "undistort": "out"}[command]
    lens = ("--lambda", "-0.2") if command == "undistort" else FAST
    before = _state(place)
    # No file may grow beyond this: the system refuses the write, as a full disk does.
    limited = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (20, 20)); "
        "from rdstitch_cli.main import run; sys.exit(run(sys.argv[1:]))"
    )
    arguments = (command, place / "a.png", place / "b.png", "-o", output, *lens)
    done = finished(start(*arguments, program=limited))
    _refused(done, 6, output)
    assert {name: data for name, data in _state(place).items() if name != "out"} == before
    assert finished(start(*arguments)).status == 0


def test_a_full_disk_keeps_the_old_picture(rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (place / "out.png").write_bytes(b"old")
    before = _state(place)

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    arguments = ("pano", place / "a.png", place / "b.png", "-o", place / "out.png", "--overwrite", *FAST)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        _refused(rdstitch(*arguments), 6, place / "out.png")
    assert _state(place) == before
    assert rdstitch(*arguments).status == 0
    assert read_image(place / "out.png").pixels.size > 0


def test_a_picture_vanishes_after_its_header_was_read(
    rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def vanish(path: Path) -> Metadata:
        found = read_metadata(path)
        if path.name == "b.png":
            path.unlink()
        return found

    monkeypatch.setattr(sources, "read_metadata", vanish)
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *FAST)
    _refused(done, 3, place / "b.png")
    assert sorted(_state(place)) == ["a.png"]


@pytest.mark.parametrize("change", ["vanishes", "shrinks"])
def test_a_picture_changes_after_its_registration(
    rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    def spoil(*arguments: Any, **options: Any) -> Any:
        verdict = judge(*arguments, **options)
        if change == "vanishes":
            (place / "b.png").unlink()
        else:
            assert cv2.imwrite(str(place / "b.png"), np.zeros((30, 40), np.uint8))
        return verdict

    monkeypatch.setattr(accept, "judge", spoil)
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *FAST)
    _refused(done, 3, place / "b.png")
    assert not (place / "out.png").exists()


@pytest.mark.parametrize(
    ("raised", "status"), [(KeyboardInterrupt(), 130), (MemoryError(), 7), (ZeroDivisionError("x\ny"), 1)]
)
def test_bad_luck_in_the_middle(
    rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch, raised: BaseException, status: int
) -> None:
    def fail(*arguments: Any, **options: Any) -> None:
        raise raised

    monkeypatch.setattr(recipes, "sidecar", fail)
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *FAST)
    assert done.status == status
    assert done.line


def test_debug_shows_where(capsys: pytest.CaptureFixture[str], place: Path) -> None:
    status = run(["--debug", "pano", str(place / "a.png"), str(place / "missing.png"), "-o", str(place / "out.png")])
    assert status == 3
    assert "Traceback" in capsys.readouterr().err


def test_nobody_reads_the_output(place: Path) -> None:
    process = start("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *FAST)
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    said = process.stderr.read()
    process.stderr.close()
    assert process.wait() == 141
    assert Outcome.of(0, "", said.decode()).err == ""
    assert (place / "out.png").exists()


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM])
def test_termination_leaves_nothing_behind(place: Path, signal_number: int) -> None:
    before = _state(place)
    process = start("pano", place / "a.png", place / "b.png", "-o", place / "out.png", "-v", *FAST)
    assert process.stderr is not None
    assert process.stderr.readline().startswith(b"rdstitch: detecting")
    process.send_signal(signal_number)
    done = finished(process)
    assert done.status == 128 + signal_number
    assert done.line.endswith("interrupted")
    assert _state(place) == before


@pytest.mark.parametrize("attempt", range(int(os.environ.get("RDSTITCH_KILLS", "4"))))
def test_killed_at_any_moment(place: Path, attempt: int) -> None:
    command = ("pano", place / "a.png", place / "b.png", "-o", place / "out.png", "--overwrite", *FAST)
    assert finished(start(*command, "--max-size", "100")).status == 0
    old = (place / "out.png").read_bytes()
    process = start(*command, "-v")
    assert process.stderr is not None
    assert process.stderr.readline()
    time.sleep(random.Random(attempt).uniform(0.0, 1.5))
    process.kill()
    finished(process)
    if (place / "out.png").read_bytes() != old:
        assert read_image(place / "out.png").pixels.size > 0
    assert json.loads((place / "out.png.json").read_text(encoding="utf-8"))["verdict"]["ok"]
    # What a killed run leaves is hidden, and no input of the next one.
    done = finished(start("mosaic", place, "-o", place / "out.png", "--overwrite", *FAST))
    assert (done.status, done.err) == (0, "")
    assert read_image(place / "out.png").pixels.size > 0
