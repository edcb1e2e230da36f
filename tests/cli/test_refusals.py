"""What cannot be done is refused: one line that names the cause, the documented status, and no file is changed."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from rdstitch_cli.stitching import resolve

from rdstitch.errors import ImpossibleCameraError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.camera_record import camera_json
from rdstitch.inputs import source as sources
from rdstitch.io.metadata import Metadata, read_metadata
from rdstitch.io.read import read_image
from rdstitch.pipeline.registration import accept, register
from rdstitch.sidecar import write
from rdstitch.verification.verdict import judge
from tests.cli.faulty import UNREADABLE, UNUSABLE
from tests.cli.running import CACHED, FAST, Run, finished, shown, sidecar_of, start, state_of
from tests.sampled import sampled

Content = str | bytes | Path | None
Files = dict[str, Content]
"""What lies in the folder, too: texts and bytes; None for an empty folder, a path for a link to it."""

PANO, MOSAIC = "pano a.png b.png -o out.png ", "mosaic a.png b.png -o out.png "
PATH = "trajectory more -o path.csv "
FOLLOW = "mosaic incoming --follow --idle 0.05 -o "
INCOMING: Files = {"incoming": None}
BROKEN: Files = {"empty.png": "", "half.png": "\x89PNG"}
MASK = cv2.imencode(".png", np.full((40, 30), 255, np.uint8))[1].tobytes()

CUT = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (300, 400), dtype=np.uint8))[1].tobytes()[:9000]


def _check(rdstitch: Run, folder: Path, arguments: list[str], status: int, *told: str) -> None:
    before = state_of(folder)
    cached = () if arguments[0] in ("apply", "undistort") else CACHED
    done = rdstitch(*arguments, *cached, status=status, out="")
    assert done.line.startswith("rdstitch: ")
    assert all(part in done.line for part in told), done.line
    assert state_of(folder) == before


@pytest.mark.parametrize(
    ("command", "status", "told"),
    [
        # Mistyped.
        ("mosaic  -o out.png", 2, "a name is empty"),
        ("pano a.png b.png -o out.png --focal= --seed 1", 2, "'--focal': expected a number"),
        ("panos a.png b.png -o out.png", 2, "No such command 'panos'"),
        ("pano a.png b.png", 2, "'-o'"),
        (PANO + "--colour", 2, "--colour"),
        (PANO + "--blen none", 2, "--blend"),
        ("a.png b.png -o out.png", 2, "'a.png' is not a command; name one first: rdstitch pano a.png b.png -o out.png"),
        ("-o out.png a.png b.png", 2, "-o belongs to a command: rdstitch pano -o out.png a.png b.png"),
        ("--scale 0.5 mosaic x", 2, "rdstitch mosaic --scale 0.5 x"),
        ("-o tiles a.png", 2, "rdstitch pano -o tiles a.png"),
        (PANO + "--max-memory 800", 2, "800M or 2G"),
        (PANO + "--max-size 2000x1000", 2, "'--max-size': expected a whole number"),
        (PANO + "--scale large", 2, "'--scale': expected a number"),
        (PANO + "--quality 101", 2, "not '101'"),
        ("undistort a.png -o straight", 2, "--camera FILE or --lambda L"),
        ("undistort a.png -o straight --lambda -0.1 --camera c.json", 2, "--camera"),
        # Absurd numbers.
        (PANO + "--tilt 200,0", 2, "'--tilt'"),
        (PANO + "--lambda 3", 2, "'--lambda': expected a number above -1 and below 1"),
        (PANO + "--focal 1e300", 2, "has a focal length of 1e+300 pixels"),
        (PANO + "--threshold nan", 2, "threshold"),
        (PANO + "--threshold 1e308", 2, "threshold"),
        *((PANO + f"--scale {scale}", 2, "'--scale': expected a number from") for scale in ("0", "1e-9", "1e300")),
        (PANO + "--scale 100", 7, "--scale nearer to 1"),
        (PANO + "--max-memory 1M", 7, "raise --max-memory"),
        ("pano a.png b.png -o out.webp --scale 5 --max-memory 120M", 7, "allows 120 MB; write a .tif"),
        *((PANO + f"--max-memory {much}", 2, "800M or 2G") for much in ("much", "0", "-3M", "2X")),
        *((MOSAIC + f"--local-alignment {cells}", 2, "from 2 to 100") for cells in ("1", "101", "much")),
        ("trajectory a.png b.png -o path --height nan", 2, "'--height': expected a number above 0"),
        ("calibrate a.png b.png -o camera.json --attitude-std -1", 2, "--attitude-std"),
        # Options that do not go together.
        (MOSAIC + "--all-blocks --strict", 2, "--strict"),
        (MOSAIC + "--whole-layers", 2, "--whole-layers goes with --layers"),
        (MOSAIC + "--idle 5", 2, "--idle goes with --follow"),
        (MOSAIC + "--height 2", 2, "--height goes with --poses or --map-server"),
        (MOSAIC + "--positions-offset 3", 2, "--positions-offset goes with --positions"),
        ("trajectory a.png b.png -o path --attitude-std 2", 2, "--attitude-std goes with --attitude"),
        (PANO + "--camera-format ros", 2, "--camera-format goes with --save-camera"),
        (PANO + "--projection sphere", 2, "--projection"),
        # Inputs that are none.
        ("mosaic a.png -o out.png", 2, "two different images"),
        ("pano a.png a.png -o out.png", 2, "a.png is named twice"),
        ("pano A.png b.png -o out.png", 3, "A.png: no such file; did you mean a.png?"),
        ("pano nofolder/a.png b.png -o out.png", 3, "there is no folder nofolder"),
        ("pano a.png nowhere://example.org/b.png -o out.png", 3, "nowhere:/example.org/b.png: "),
        ("trajectory nowhere://example.org/b -o path --follow", 3, "nowhere://example.org/b: OpenCV cannot open"),
        ("mosaic nofolder/ -o out.png", 3, "nofolder: no such folder"),
        ("mosaic *.nothing -o out.png", 3, "*.nothing: "),
        ("mosaic @more -o out.png", 3, "more: "),
        ("mosaic @missing.txt -o out.png", 3, "missing.txt: "),
        ("mosaic . --exclude c -o out.png", 2, "they are called like a.png, and patterns like a* fit too"),
        ("pano a.png stranger.png -o out.png", 4, "stranger.png"),
        (PANO + "--camera a.png", 3, "a.png: "),
        (PANO + "--config missing.toml", 3, "missing.toml"),
        (MOSAIC + "--mask mask.png", 3, "mask.png"),
        ("apply a.png --images more -o out.png", 3, "a.png: "),
        ("apply more --images more -o out.png", 3, "more: "),
        # Outputs that cannot be.
        ("pano a.png b.png -o -", 6, "-: "),
        ("pano a.png b.png -o missing/out.png", 6, "missing"),
        ("pano a.png b.png -o a.png/out.png", 6, "a.png/out.png"),
        ("pano a.png b.png -o out.xyz", 6, "out.xyz: unknown file type"),
        ("pano a.png b.png -o out", 6, "out: "),
        (f"pano a.png b.png -o {'x' * 300}.png", 6, "x.png: "),
        *((f"{command} a.png b.png -o a.png --overwrite", 6, "a.png: ") for command in ("pano", "mosaic")),
        (PANO + "--report out.png", 6, "out.png: unknown file type"),
        (PANO + "--report report.pdf", 6, ".html"),
        (PANO + "--save-camera more/../out.png.json", 6, "is the name of two outputs"),
        ("mosaic a.png b.png -o x.dzi --report x.html", 6, "two outputs"),
        ("mosaic a.png b.png -o x.png --poses x.png.json", 6, "two outputs"),
        # What could only fail after the work.
        (MOSAIC + "--poses geo.txt", 2, "geo.txt: poses on the map need a georeferenced output"),
        (MOSAIC + "--poses poses.csv --frame map", 2, "choose another --frame"),
        (FOLLOW + "new.png --dry-run", 2, "--follow has no --dry-run"),
        (MOSAIC + "--model homography --poses poses.csv", 2, "a homography model has no poses"),
        (MOSAIC + "--model rotation --map-server map --height 2", 2, "a rotation model has no poses"),
        ("trajectory a.png stranger.png -o path.csv --odometry drive.csv", 3, "drive.csv: "),
        *((PATH + f"--model {model}", 2, f"a {model} model has no poses") for model in ("rotation", "homography")),
        ("mosaic . --exclude *.png -o out.png", 2, "--exclude and --include-only leave 0 of 3 images"),
        ("trajectory a.png b.png -o path --plot path", 6, "path: is the name of two outputs"),
        ("calibrate a.png b.png -o camera.txt", 6, ".yml"),
        ("undistort a.png -o . --lambda -0.2", 6, "a.png: is read as input"),
    ],
)  # fmt: skip
def test_commands(rdstitch: Run, here: Path, command: str, status: int, told: str) -> None:
    _check(rdstitch, here, command.split(" ") if command[-1] != " " else command.split(), status, told)


def _tables() -> list[tuple[str, int, str | tuple[str, ...], Files]]:
    rows: list[tuple[str, int, str | tuple[str, ...], Files]] = []
    for content, told in (
        ("", "psi"),
        ("name,psi\n", "theta"),
        ("name,psi,theta\nother.png,1,2\n", "no line for"),
        *((f"name,psi,theta\na.png,{wrong}\n", "line 2") for wrong in ("much,2", "nan,2", "95,2", "1")),
        ("name,psi,theta\na.png,1,2\na.png,1,2\n", "twice"),
        ('name,psi,theta\n"a' + "\0" * 200_000, "is not UTF-8 text"),
    ):
        rows.append((MOSAIC + "--attitude imu.csv", 3, told, {"imu.csv": content}))
    camera = '{"format": "rdstitch camera", "version": 1, "image_size": [400, 300], "center_px": [1, 2], "lambda": 0}'
    for content in (
        *("", "text", "[]", "null", "{}", "\udcff\udcfe", "[" * 100_000, camera.replace(" 1,", " 99,", 1)),
        *(camera.replace('"lambda": 0', f'"lambda": {wrong}') for wrong in ("NaN", "5")),
        *(camera.replace("[400, 300]", wrong) for wrong in ("[1e400, 3]", '"wide"')),
    ):
        rows += [(PANO + "--camera camera.json", 3, "camera.json: ", {"camera.json": content})]
    for content, named, hint in (
        ("[mosaik]\n", "mosaik", "do you mean 'mosaic'"),
        ("[mosaic]\nblent = 'none'\n", "mosaic.blent", "do you mean 'blend'"),
        ("[common]\nwork_megapixels = 2\n", "common.work_megapixels", "do you mean 'work-megapixels'"),
        ("[trajectory]\nscale = 2\n", "trajectory.scale", "no such option"),
        ("[common]\ndebug = true\n", "common.debug", "no such option"),
        ("[common]\nconfig = 'more.toml'\n", "common.config", "no such option"),
        *((f"[common]\nattitude-std = {wrong}\n", "attitude-std", "") for wrong in ("-1.0", "nan", "true", "[1.0]")),
        ("scale = 2\n", "scale", ""),
        ("pano = 2\n", "pano", "table"),
        ("[pano]\nscale = 'large'\n", "pano.scale", "a number"),
        ("[pano]\nscale = true\n", "pano.scale", "a number"),
        ("[pano]\nseed = 1.5\n", "pano.seed", "a whole number"),
        ("[pano]\nseed = -1\n", "pano.seed", "-1"),
        ("[pano]\nmax-size = ''\n", "pano.max-size", "a whole number"),
        ("[pano]\nstrict = 1\n", "pano.strict", "true or false"),
        ("[pano]\nblend = 'magic'\n", "pano.blend", "feather"),
        ("[pano]\ntilt = [1, 2]\n", "pano.tilt", "a text"),
        ("[pano]\ntilt = '1'\n", "pano.tilt", "2 numbers, degrees"),
        ("[apply]\nimages = 'flight'\n", "apply.images", "a list"),
        ("[pano\n", "is not TOML", "line 1"),
    ):
        # The whole file is checked, whichever command runs.
        rows.append((PANO + "--config c.toml", 3, ("c.toml: ", named, hint), {"c.toml": content}))
    for content, told in (
        ("@list.txt\n", "list.txt: the list of images names itself"),
        ("x" * 300, "File name too long"),
        ("a/" * 3000, "File name too long"),
        ("[ab].png\0missing\n.png", "missing .png: no such file"),
        ("\ufeffa.png\r\nmissing.png\r\n", "missing.png: no such file"),
    ):
        command = "pano" if told.startswith("missing") else "mosaic"
        rows.append((f"{command} @list.txt -o out.png", 3, told, {"list.txt": content}))
    return rows


@pytest.mark.parametrize(
    ("command", "status", "told", "files"),
    [
        *_tables(),
        ("mosaic empty -o out.png", 3, "empty: ", {"empty": None}),
        ("mosaic texts -o out.png", 3, "texts: ", {"texts": None, "texts/notes.txt": "no images"}),
        ("pano a.png link.png -o out.png", 2, "two different images", {"link.png": Path("a.png")}),
        (MOSAIC + "--mask mask.png", 3, "mask.png: a mask of 30 x 40 pixels does not fit", {"mask.png": MASK}),
        (MOSAIC + "--mask mask.png", 3, "mask.png: ", {"mask.png": "no image"}),
        *(
            (f"{command} a.png stranger.png empty.png half.png -o {output}", 4,
             ("no two images overlap", "empty.png: is empty", "half.png: "), BROKEN)
            for command, output in (("mosaic", "o.png"), ("calibrate", "o.json"), ("trajectory", "o.csv"))
        ),
        # Outputs that exist.
        (PANO, 6, "out.png: exists", {"out.png": "mine"}),
        (MOSAIC, 6, "out.png: exists", {"out.png": "mine"}),
        (PANO, 6, "out.png.json: exists", {"out.png.json": "mine"}),
        (PANO, 6, "out.png", {"out.png": None}),
        (PANO, 6, "out.png", {"out.png.json": None}),
        ("pano a.png b.png -o link.png --overwrite", 6, "link.png: ", {"link.png": Path("a.png")}),
        ("pano a.png b.png -o link.png --overwrite", 6, "link to nothing", {"link.png": Path("disk/image.png")}),
        ("mosaic a.png b.png -o x.dzi", 6, "x.html", {"x.html": "mine"}),
        ("calibrate a.png b.png -o camera.json", 6, "--overwrite", {"camera.json": "mine"}),
        ("calibrate a.png b.png -o camera.json --report r.html", 6, "r.html", {"r.html": "mine"}),
        (MOSAIC + "--layers file", 6, "cannot make the folder", {"file": "mine"}),
        ("mosaic a.png b.png -o layers/a.tif --layers layers", 6, "two outputs", {"layers": None}),
        (MOSAIC + "--layers layers", 6, "exists already", {"layers": None, "layers/a.tif": "mine"}),
        # What is read is never replaced.
        (PATH.replace("path.csv", "imu.csv --attitude imu.csv --overwrite"), 6, "imu.csv: is read as input",
         {"imu.csv": "name,psi,theta\nframe_0000.png,0,0\nframe_0001.png,0,0\n"}),
        (PATH.replace("path.csv", "t.csv --timestamps t.csv --overwrite"), 6, "t.csv: is read as input",
         {"t.csv": "frame_0000.png,0\nframe_0001.png,1\n"}),
        (PATH.replace("path.csv", "c.toml --config c.toml --overwrite"), 6, "c.toml: is read as input",
         {"c.toml": "[common]\nseed = 1\n"}),
        (PATH.replace("path.csv", "c.json --camera c.json --overwrite"), 6, "c.json: is read as input",
         {"c.json": json.dumps(camera_json(Camera((400, 300), -0.2)))}),
        ("trajectory @n.txt -o n.txt --overwrite", 6, "n.txt: is read as input", {"n.txt": "a.png\nb.png\n"}),
        ("mosaic more -o b.png --mask b.png --overwrite", 6, "b.png: is read as input", {}),
        ("mosaic more -o masks/frame_0000.png --mask masks --overwrite", 6, "frame_0000.png: is read as input",
         {"masks": None, "masks/frame_0000.png": MASK}),
        ("mosaic a.png cut.jpg -o out.png", 4, "left out cut.jpg: not an image that can be read", {"cut.jpg": CUT}),
        # What would fail at the end of a run that follows a folder.
        (FOLLOW + "out.png", 3, "no images", INCOMING),
        (FOLLOW + "out.png", 6, "out.png: ", INCOMING | {"out.png": "mine"}),
        (FOLLOW + "out.png", 6, "out.preview.jpg", INCOMING | {"out.preview.jpg": "mine"}),
        (FOLLOW + "out.png --overwrite", 3, "no images", INCOMING | {"out.preview.jpg": "mine"}),
        (FOLLOW + "out.xyz", 6, "out.xyz", INCOMING),
        (FOLLOW + "incoming/out.png", 2, "incoming", INCOMING),
        (FOLLOW + "linked/out.png", 2, "linked", INCOMING | {"linked": Path("incoming")}),
        (FOLLOW + "out.png --save-camera used.json", 6, "used.json", INCOMING | {"used.json": "{}"}),
        ("trajectory incoming -o path.csv --follow --plot used.svg", 6, "used.svg", INCOMING | {"used.svg": "mine"}),
        ("mosaic incoming a.png -o out.png --follow", 2, "--follow", INCOMING),
        ("mosaic nofolder -o out.png --follow", 3, "nofolder", {}),
    ],
)  # fmt: skip
def test_beside_these_files(
    rdstitch: Run, here: Path, command: str, status: int, told: str | tuple[str, ...], files: Files
) -> None:
    for name, content in files.items():
        file = here / name
        if content is None:
            file.mkdir()
        elif isinstance(content, Path):
            file.symlink_to(content)
        else:
            file.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogateescape"))
    _check(rdstitch, here, command.split(), status, *([told] if isinstance(told, str) else told))


@pytest.mark.parametrize(("kind", "status"), [*((kind, 3) for kind in UNREADABLE), *((kind, 4) for kind in UNUSABLE)])
def test_images(rdstitch: Run, place: Path, kind: str, status: int) -> None:
    bad = {**UNREADABLE, **UNUSABLE}[kind](place / "b.png", place)
    _check(
        rdstitch, place, ["pano", "-o", f"{place}/out.png", f"{place}/a.png", str(bad)], status, shown(Path(bad.name))
    )


@pytest.mark.parametrize("kind", ["missing", "name that is not UTF-8", "JPEG cut at 50%", "one pixel", "black"])
def test_a_mosaic_leaves_such_images_out_by_name(rdstitch: Run, place: Path, kind: str) -> None:
    bad = {**UNREADABLE, **UNUSABLE}[kind](place / "b.png", place)
    rdstitch("mosaic", place / "a.png", place / "b.png", bad, "-o", place / "out.jpg", *CACHED, told=shown(bad))
    assert [image["used"] for image in sidecar_of(place / "out.jpg")["images"]] == [True, True, False]


def test_samples_of_two_kinds(rdstitch: Run, here: Path) -> None:
    assert cv2.imwrite("deep.png", read_image(here / "b.png").pixels.astype(np.uint16) * 257)
    _check(rdstitch, here, ["pano", "a.png", "deep.png", "-o", "out.png"], 3, "deep.png")


def test_an_image_larger_than_the_memory_limit(rdstitch: Run, here: Path) -> None:
    Image.new("RGB", (6000, 5000)).save("large.png")
    limit = ("-o", "out.png", "--max-memory", "100M")
    _check(rdstitch, here, ["pano", "a.png", "large.png", *limit], 7, "large.png: 6000 x 5000 pixels need")
    rdstitch("mosaic", "a.png", "b.png", "large.png", *limit, *CACHED, told="left out large.png")


@pytest.mark.parametrize(("mode", "file", "status"), [(os.R_OK, "b.png", 3), (os.W_OK, "out.png", 6)])
def test_what_may_not_be_accessed(
    rdstitch: Run, here: Path, monkeypatch: pytest.MonkeyPatch, mode: int, file: str, status: int
) -> None:
    # Simulated: the superuser, under whom tests may run, may read and write everywhere.
    allowed = os.access

    def access(path: Path, wanted: int) -> bool:
        return not (wanted & mode and (mode == os.W_OK or Path(path).name == file)) and allowed(path, wanted)

    monkeypatch.setattr(os, "access", access)
    _check(rdstitch, here, PANO.split(), status, file)


def _spoils(change: str) -> Callable[..., Any]:
    """The verdict, after which ``b.png`` is another file."""

    def spoil(*arguments: Any, **options: Any) -> Any:
        verdict = judge(*arguments, **options)
        Path("b.png").unlink()
        if change == "shrinks":
            assert cv2.imwrite("b.png", np.zeros((30, 40), np.uint8))
        return verdict

    return spoil


@pytest.mark.parametrize("change", ["vanishes", "shrinks"])
def test_an_image_changes_afterwards(rdstitch: Run, here: Path, monkeypatch: pytest.MonkeyPatch, change: str) -> None:
    monkeypatch.setattr(accept, "judge", _spoils(change))
    rdstitch(*PANO.split(), *CACHED, status=3, told="b.png")
    assert not Path("out.png").exists()


def test_an_image_vanishes_after_its_header_is_read(rdstitch: Run, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def vanish(path: Path) -> Metadata:
        metadata = read_metadata(path)
        if path.name == "b.png":
            path.unlink()
        return metadata

    monkeypatch.setattr(sources, "read_metadata", vanish)
    rdstitch(*PANO.split(), *CACHED, status=3, told="b.png")
    assert not Path("out.png").exists()


def _too_large(*_: object, **__: object) -> None:
    cv2.resize(np.zeros((1000, 1000)), (2**20, 2**20))


@pytest.mark.parametrize(
    ("module", "function", "raised", "status", "told"),
    [
        (register, "separate_lenses", ImpossibleCameraError("distortion -1.2 folds"), 4, "no reliable result"),
        (register, "separate_lenses", _too_large, 7, "out of memory"),
        (write, "sidecar", KeyboardInterrupt(), 130, "interrupted"),
        (write, "sidecar", MemoryError(), 7, "memory"),
        (write, "sidecar", ZeroDivisionError("x\ny"), 1, "x y"),
    ],
)
def test_what_fails_in_the_middle(
    rdstitch: Run,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    module: Any,
    function: str,
    raised: Any,
    status: int,
    told: str,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise raised

    monkeypatch.setattr(module, function, raised if callable(raised) else fail)
    _check(rdstitch, here, PANO.split(), status, told)


def test_an_address_among_inputs_keeps_its_slashes() -> None:
    assert resolve(("http://a.b/c.jpg", Path("d.jpg"))) == ["http://a.b/c.jpg", Path("d.jpg")]


@pytest.mark.parametrize("command", sampled(["pano", "calibrate", "trajectory", "undistort"]))
def test_a_full_disk(place: Path, command: str) -> None:
    output = place / {"pano": "out.png", "calibrate": "out.json", "trajectory": "out.csv", "undistort": "out"}[command]
    lens = ("--lambda", "-0.2") if command == "undistort" else FAST
    before = state_of(place)
    # No file may grow beyond this: the system refuses the write, as a full disk does.
    limited = (
        "import resource, sys; sys.dont_write_bytecode = True; resource.setrlimit(resource.RLIMIT_FSIZE, (20, 20)); "
        "from rdstitch_cli.main import run; sys.exit(run(sys.argv[1:]))"
    )
    arguments = (command, place / "a.png", place / "b.png", "-o", output, *lens)
    done = finished(start(*arguments, program=limited))
    assert (done.status, output.name in done.line) == (6, True)
    assert {name: data for name, data in state_of(place).items() if name != "out"} == before
    assert finished(start(*arguments)).status == 0
