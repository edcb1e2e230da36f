"""The public API: the examples of its docstrings run, and every name is typed and described."""

import ast
import doctest
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import rdstitch
from tests.cli.running import copied


def _run(test: doctest.DocTest) -> None:
    output: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL)
    results = runner.run(test, out=output.append)
    assert results.failed == 0, "".join(output)


@pytest.fixture
def images(frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The images that the examples name, in the current folder."""
    copied(frames, tmp_path, "left.png", "middle.png", "right.png")
    copied(frames, tmp_path / "flight")
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("images")
@pytest.mark.parametrize("name", ["pano", "mosaic", "estimate_radial_homography"])
def test_the_examples_of_help_run(name: str) -> None:
    function = getattr(rdstitch, name)
    (test,) = doctest.DocTestFinder(recurse=False).find(function, name, globs={"np": np})
    assert test.examples
    assert "Returns\n" in (function.__doc__ or "").replace("    ", "")
    _run(test)


def test_the_package_shows_its_names_and_loads_them_when_they_are_used() -> None:
    assert set(rdstitch.__all__) < set(dir(rdstitch))
    assert "__version__" in dir(rdstitch)
    program = (
        "import sys, rdstitch; print(rdstitch.__version__); heavy = {'numpy', 'scipy', 'cv2'} & sys.modules.keys(); "
        "rdstitch.errors.InputError, rdstitch.synthetic.pair_poses; print(sorted(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == f"{metadata.version('rdstitch')}\n[]\n"
    with pytest.raises(AttributeError, match="no attribute 'stitch'"):
        rdstitch.stitch  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.usefixtures("images")
def test_results_show_themselves_in_one_line() -> None:
    result = rdstitch.mosaic(["flight/"], options=rdstitch.StitchOptions(workers=1))
    registration = result.registration
    path = rdstitch.Trajectory.from_alignment(registration.alignment)
    failed = rdstitch.RadialHomography.failed("too few matches", registration.camera, registration.camera, 3)
    shown = [result, registration, registration.alignment, path, registration.pairs[0].relation, failed]
    lines = [repr(each) for each in (*shown, result.composite)]
    assert all(len(line) < 120 and "\n" not in line and line[0] == "<" for line in lines), lines
    assert lines[5] == "<RadialHomography failed: too few matches>"


def test_type_checkers_read_the_same_names_and_homes() -> None:
    stub = ast.parse(Path(rdstitch.__file__).with_suffix(".pyi").read_text())
    homes = [
        (alias.asname, node.module) for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names
    ]
    assert homes == [*vars(rdstitch)["_HOMES"].items()]
