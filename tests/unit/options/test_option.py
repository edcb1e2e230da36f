"""What is declared once of an option is what is checked."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest

import rdstitch
from rdstitch import Camera, CompositeOptions, FilesBeside, StitchOptions, TileOptions
from rdstitch.errors import ArgumentError
from rdstitch.options.estimation_options import EstimationOptions
from rdstitch.options.option import Option, Options, Range, Unit, declared, documented


@documented
@dataclass(frozen=True)
class _Options(Options):
    """Some."""

    number: Annotated[float, Option("A number.", within=Range(above=0.0, most=10.0))] = 1.0
    count: Annotated[int | Literal["auto"] | None, Option("How many.", within=Range(least=2))] = None
    word: Annotated[Literal["one", "two", "three"], Option("A word.")] = "one"
    sides: Annotated[tuple[float, float] | None, Option("Two sides.")] = None
    lines: Annotated[Literal["off"] | tuple[tuple[float, float], ...], Option("Lines.")] = "off"
    names: Annotated[tuple[str, ...], Option("Names.")] = ()
    file: Annotated[Path | None, Option("A file.")] = None
    switch: Annotated[bool, Option("On or off.")] = False


@pytest.mark.parametrize(
    "given",
    [
        {"number": 10},
        {"number": np.float32(0.5), "count": np.int64(2)},
        {"count": "auto", "word": "three"},
        {"sides": (1.0, -1.0), "lines": ((0.0, 1.0), (2.0, 3.0)), "names": ("a", "b")},
    ],
)
def test_what_fits_is_taken(given: dict[str, Any]) -> None:
    options = _Options(**given)
    assert {name: getattr(options, name) for name in given} == given


def test_texts_become_paths_and_lists_tuples() -> None:
    given: Any = {"file": "a/b", "sides": [1.0, 2.0], "lines": [[0.0, 1.0]], "names": ["a"]}
    assert _Options(**given) == _Options(file=Path("a/b"), sides=(1.0, 2.0), lines=((0.0, 1.0),), names=("a",))


@pytest.mark.parametrize(
    ("name", "value", "held"),
    [
        ("number", 2, "2.0"),
        ("count", 2, "2"),
        ("sides", np.array([1, 2]), "(1.0, 2.0)"),
        ("lines", [[0, 1]], "((0.0, 1.0),)"),
        ("switch", True, "True"),
    ],
)
def test_whole_numbers_are_floats_where_the_type_says_so(name: str, value: Any, held: str) -> None:
    assert repr(getattr(_Options(**{name: value}), name)) == held


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("number", 0.0, "a number above 0 and of at most 10"),
        *(("number", value, "a number") for value in (10.1, math.nan, math.inf, "3", True, None)),
        *(("count", value, "auto or a whole number of at least 2") for value in (1, 2.0, "2", False)),
        *(("word", value, "one of one, two, three") for value in ("four", None, 1)),
        *(("sides", value, "2 numbers") for value in ((1.0,), (1.0, 2.0, 3.0), (1.0, math.nan), "12", 5.0, [1.0])),
        *(("lines", value, "off") for value in (((0.0,),), "on", [[0.0, "x"]])),
        *(("names", value, "a list") for value in ("a", (1,))),
        ("file", 3, "a file"),
        ("switch", "yes", "true or false"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(name: str, value: Any, expected: str) -> None:
    with pytest.raises(ArgumentError) as caught:
        _Options(**{name: value})
    assert str(caught.value).startswith(f"{name} must be {expected}")
    assert str(caught.value).endswith(f", not {value!r}") or isinstance(value, list)


def test_options_within_options_are_of_their_class() -> None:
    for name, given in (("features", "orb"), ("composite", {"scale": 2.0})):
        with pytest.raises(ArgumentError, match=rf"{name} must be \w+Options, not "):
            StitchOptions(**{name: given})  # type: ignore[arg-type]
    for name in ("camera", "odometry"):
        with pytest.raises(ArgumentError, match=f"{name} must be {name.title()} or a file, not 3"):
            StitchOptions(**{name: 3})  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="distortion must be"):
        TileOptions(distortion=3.0)


def test_the_compositor_has_its_own_number_of_threads_where_it_is_given() -> None:
    composite = CompositeOptions(workers=1)
    assert StitchOptions(workers=2, composite=composite).compositing.workers == 1
    assert StitchOptions(workers=2).compositing.workers == 2


def test_the_class_says_what_its_options_are() -> None:
    assert "number\n    A number." in (_Options.__doc__ or "")


def test_angles_have_their_unit_for_each_reader() -> None:
    for name in ("tilt", "attitude_std"):
        text = declared(StitchOptions)[name].option
        documentation = (StitchOptions.__doc__ or "").split(f"\n{name}\n")[1].splitlines()[0]
        assert "radians" in documentation
        assert "degrees" not in documentation
        assert "degrees" in text.in_unit(Unit.DEGREES)
    for name in ("yaw", "pitch", "roll", "rotate"):
        assert "degrees" in (CompositeOptions.__doc__ or "").split(f"\n{name}\n")[1].splitlines()[0]


@pytest.mark.parametrize("tilt", [(math.nan, 0.0), (2.0, 0.0)])
def test_a_tilt_is_in_radians(tilt: tuple[float, float]) -> None:
    with pytest.raises(ArgumentError, match="radians"):
        StitchOptions(tilt=tilt)


@pytest.mark.parametrize("extent", [(1.0, 2.0, 3.0), (3.0, 0.0, 1.0, 2.0)])
def test_an_extent_has_four_sides_in_their_order(extent: Any) -> None:
    with pytest.raises(ArgumentError, match=r"extent must be (4 numbers|west, south, east and north)"):
        CompositeOptions(extent=extent)


@pytest.mark.parametrize("name", ["cache", "save_camera", "camera", "positions", "gcp", "mask", "attitude", "odometry"])
def test_an_empty_name_is_not_the_current_folder(name: str) -> None:
    given: Any = {name: ""}
    with pytest.raises(ArgumentError, match=f"{name} must be .*, not ''"):
        StitchOptions(**given)


def test_a_camera_is_that_of_this_package_and_read_before_it_is_asked_for_its_lens() -> None:
    other: Any = type("Camera", (), {})()
    with pytest.raises(ArgumentError, match="camera must be Camera or a file"):
        StitchOptions(camera=other)
    with pytest.raises(ArgumentError, match=r"x\.json: has not been read yet"):
        _ = StitchOptions(camera="x.json").known_distortion
    wrong: Any = {"select_below": "50"}
    with pytest.raises(ArgumentError, match="select_below must be a whole number"):
        EstimationOptions(**wrong)


def test_arrays_become_tuples_of_numbers() -> None:
    options: Any = {"tilt": np.radians([3, 0]), "max_iterations": np.int64(5)}
    assert StitchOptions(**options) == StitchOptions(tilt=(math.radians(3), 0.0), max_iterations=5)
    extent: Any = np.array([0, 0, 2, 3])
    assert hash(CompositeOptions(extent=extent)) == hash(CompositeOptions(extent=(0, 0, 2, 3)))
    for sides in (np.zeros(3), {1.0, 2.0}, {1.0: 0, 2.0: 0}):
        with pytest.raises(ArgumentError, match="tilt must be 2 numbers"):
            StitchOptions(tilt=sides)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("saved", "given", "changed"),
    [
        ({"max_size": 1200, "crop": "auto"}, {"extent": (0, 0, 1, 1)}, {"max_size": None, "crop": "none"}),
        ({"max_size": 1200}, {"scale": 1.0}, {"max_size": None}),
        ({"max_size": 1200}, {"gsd": None}, {}),
        ({"max_size": 1200, "scale": 0.5}, {"scale": 2.0, "max_size": 9}, {}),
        ({"scale": 0.5, "rotate": 9.0}, {"like": "a.tif"}, {"scale": 1.0, "rotate": 0.0}),
        ({"like": "a.tif", "extent": (0, 0, 1, 1)}, {"gsd": 0.1}, {"like": None, "extent": None}),
        ({"like": "a.tif"}, {"rotate": 0.0, "crop": "none"}, {}),
        ({"like": "a.tif", "extent": (0, 0, 1, 1)}, {"like": Path("a.tif")}, {}),
        ({"max_size": 1200}, {"extent": np.array([0, 0, 1, 1])}, {"max_size": None}),
        ({"gsd": 0.1}, {"scale": 1.0}, {"gsd": None}),
        ({"gsd": 0.1}, {"georeference": "off"}, {"gsd": None}),
        ({"georeference": "off"}, {"gsd": 0.1}, {"georeference": "auto"}),
        ({"rectangle": (0, 0, 9, 0, 9, 9, 0, 9)}, {"straighten": "off"}, {"rectangle": None}),
        ({"level": True}, {"straighten": "auto"}, {"level": False}),
    ],
)
def test_what_is_given_takes_the_place_of_what_contradicts_it(saved: Any, given: Any, changed: Any) -> None:
    assert CompositeOptions(**saved).overridden(**given) == CompositeOptions(**saved | given | changed)


def test_what_contradicts_or_is_unknown_is_refused() -> None:
    with pytest.raises(ArgumentError, match="camera and distortion"):
        StitchOptions(camera=Camera((40, 30)), distortion=-0.1)
    with pytest.raises(ArgumentError, match=r"\{number\} in grid"):
        TileOptions(grid="r{row}c{col}", columns=4)
    with pytest.raises(ArgumentError, match="max_memory must be"):
        CompositeOptions(max_memory=800)
    for recipe, inputs in ((rdstitch.apply, ("none.json", "none")), (rdstitch.tiles, ("none",))):
        with pytest.raises(ArgumentError, match="no option 'overwite'; do you mean 'overwrite'"):
            recipe(*inputs, overwite=True)
    with pytest.raises(ArgumentError, match="no option 'scal'; do you mean 'scale'"):
        rdstitch.apply("none.json", ["none"], scal=0.5)
    for wrong in ({"file_format": "kiti"}, {"height": 0}, {"frame": "map"}):
        with pytest.raises(ArgumentError, match=f"{next(iter(wrong))} must be"):
            rdstitch.trajectory("none", **wrong)


def test_files_that_are_read_are_inputs_that_no_output_may_replace(tmp_path: Path) -> None:
    (mask := tmp_path / "mask.png").touch()
    grid = CompositeOptions(like=tmp_path / "grid.tif")
    given: dict[str, Any] = {"attitude": "xmp", "save_camera": "new.json", "reference": "a", "cache": tmp_path}
    options = StitchOptions(**given, camera="old.json", mask=tmp_path, odometry="/odom", composite=grid)
    assert {*options.files} == {Path("old.json"), mask, Path("/odom"), tmp_path / "grid.tif"}
    assert TileOptions(flat_field="auto", positions=np.zeros((2, 2))).files == []
    assert TileOptions(flat_field="flat.tif", positions="p.csv").files == [Path("p.csv"), Path("flat.tif")]
    with pytest.raises(ArgumentError, match="positions and grid"):
        TileOptions(positions=np.zeros((2, 2)), grid="{row}")


def test_what_is_of_another_kind_is_refused_by_name() -> None:
    options: Any = {"workers": 2}
    recipes: list[Any] = [rdstitch.pano, rdstitch.mosaic, rdstitch.calibrate, rdstitch.trajectory]
    for recipe in recipes:
        with pytest.raises(ArgumentError, match="options must be StitchOptions, not"):
            recipe(["none"], options=options)
        for every in (0, -1, 1.5):
            with pytest.raises(ArgumentError, match="every must be a whole number from 1 to 1000000"):
                recipe(["none"], every=every)
    with pytest.raises(ArgumentError, match="every must be a whole number from 1 to 1000000"):
        rdstitch.examine(["none"], every=0)
    with pytest.raises(ArgumentError, match="beside must be FilesBeside, not"):
        rdstitch.mosaic(["none"], beside=options)
    with pytest.raises(ArgumentError, match="options must be TileOptions, not"):
        rdstitch.tiles(["none"], options=options)
    with pytest.raises(ArgumentError, match="options must be ApplyOptions, not"):
        rdstitch.apply("none.json", ["none"], options=options)
    with pytest.raises(ArgumentError, match="options must be StitchOptions, not"):
        rdstitch.Tracker(options)
    with pytest.raises(ArgumentError, match="poses must be FollowedPoses, not"):
        rdstitch.Tracker(poses=options)
    images: Any = [np.zeros((40, 30), np.uint8)] * 2
    for count in (2, 0):
        with pytest.raises(ArgumentError, match=f"image must be one image, not {count}"):
            rdstitch.Tracker().add(images[:count])


@pytest.mark.parametrize("wrong", [{"height": -2.0}, {"frame": "enuu"}])
def test_poses_are_printed_in_a_frame_above_the_plane(wrong: Any) -> None:
    with pytest.raises(ArgumentError, match=f"{next(iter(wrong))} must be"):
        rdstitch.FollowedPoses(**wrong)


def test_files_beside_neither_change_the_reference_nor_are_forgotten(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="reference and frame first both name the reference"):
        rdstitch.mosaic(["none"], None, StitchOptions(reference="a.png"), beside=FilesBeside(frame="first"))
    images = [np.zeros((40, 30), np.uint8)] * 2
    with pytest.raises(ArgumentError, match="--map-server is made from the output"):
        rdstitch.mosaic(images, beside=FilesBeside(map_server=tmp_path / "map", height=1.0))
    for beside in (FilesBeside(poses=tmp_path / "p.csv"), FilesBeside(layers=tmp_path / "layers")):
        with pytest.raises(ArgumentError, match=r"calibrate writes no (poses|layers): beside its result"):
            rdstitch.calibrate(images, beside=beside)
    with pytest.raises(ArgumentError, match=r"tiles writes no map_server: .* hugin_project, layers, report"):
        rdstitch.tiles(images, tmp_path / "a.tif", beside=FilesBeside(map_server=tmp_path / "map"))
    for recipe in (rdstitch.calibrate, rdstitch.trajectory):
        with pytest.raises(ArgumentError, match=f"{recipe.__name__} composites nothing: leave out dry_run"):
            recipe(images, options=StitchOptions(dry_run=True))
