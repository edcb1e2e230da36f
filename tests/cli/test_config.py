"""``--config``: defaults from a file, checked, and flags that win."""

import json
import re
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import click
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rdstitch_cli.config import read_config
from rdstitch_cli.flags import EnteredValue
from rdstitch_cli.main import cli

from rdstitch.errors import InputError
from rdstitch.geometry.camera import Camera
from tests.cli.running import Run, sidecar_of
from tests.damaged_texts import damaged_text

_DOCUMENT = Path(__file__).parents[2] / "docs" / "guide.md"


def _example() -> str:
    found = re.search(r"```toml\n(.*?)```", _DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    return found[1]


def _written(folder: Path, text: str) -> Path:
    file = folder / "config.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_the_documented_example_is_read(tmp_path: Path) -> None:
    file = _written(tmp_path, _example())
    common: dict[str, Any] = {"kind": "sift", "work_megapixels": "2.5", "camera": "camera.json"}
    common |= {"overwrite": True, "workers": "2"}
    assert read_config(file, cli.load_all(), "calibrate") == common
    # The parameter of --format is called otherwise.
    assert read_config(file, cli.load_all(), "trajectory") == {**common, "file_format": "tum", "height": "0.42"}
    assert read_config(file, cli.load_all(), "undistort") == {"camera": "camera.json", "overwrite": True}


def test_a_common_option_is_that_of_the_command_that_runs(tmp_path: Path) -> None:
    file = _written(tmp_path, '[common]\nlambda = "auto"\nformat = "tum"\n')
    assert read_config(file, cli.load_all(), "tiles") == {"distortion": "auto"}
    assert read_config(file, cli.load_all(), "doctor") == {}
    with pytest.raises(InputError, match="lambda"):
        read_config(file, cli.load_all(), "pano")


def test_flags_win_then_the_command_then_common(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    file = _written(
        tmp_path,
        "[common]\nlambda = -0.15\nseed = 7\nthreshold = 2.5\nattitude-std = 2\nwhole-layers = true\n"
        "[pano]\nlambda = -0.2\nscale = 0.5\nworkers = 1\n",
    )
    arguments = ("pano", *frames[:2], "--config", file, "--max-features", "600")
    assert rdstitch(*arguments, "-o", tmp_path / "a.png").out == "-0.200000\n"
    assert rdstitch(*arguments, "-o", tmp_path / "b.png", "--lambda", "-0.21", "--scale", "1").out == "-0.210000\n"
    a, b = (sidecar_of(tmp_path / f"{name}.png")["options"] for name in "ab")
    assert (a["seed"], a["threshold"], a["composite"]["scale"], a["workers"]) == (7, 2.5, 0.5, 1)
    assert (b["seed"], b["composite"]["scale"]) == (7, 1.0)


def test_a_required_option_may_be_in_the_file(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    Camera((400, 300), -0.2).save(tmp_path / "camera.json")
    lines = ["[undistort]", f"camera = '{tmp_path / 'camera.json'}'", f"output = '{tmp_path / 'straight'}'"]
    rdstitch("undistort", frames[0], "--config", _written(tmp_path, "\n".join(lines)), err="")
    assert (tmp_path / "straight" / frames[0].name).exists()


def _plausible(option: click.Option) -> Any:
    if option.is_flag:
        return True
    if isinstance(option.type, click.Choice):
        return str(option.type.choices[0])
    if isinstance(option.type, EnteredValue) and not option.type.entry.words and option.metavar != "L":
        with suppress(click.BadParameter):
            option.type.convert("2", None, None)
            return 2
    return {
        "tilt": "1,2",
        "attitude_std": "0.5",
        "max_memory": "1G",
        "local_alignment": "auto",
        "every": "auto",
        "work_megapixels": "0.5",
        "epsg": "25832",
        "extent": "0,0,9,9",
        "bands": "NIR=*_NIR.TIF,RED=*_RED.TIF",
        "distortion": "0.1",
        "z": "max",
        "rectangle": "0,0,9,0,9,9,0,9",
        "straighten": "auto",
    }.get(option.name or "", "name")


@pytest.mark.parametrize("name", sorted(cli.load_all()))
def test_every_option_can_be_in_the_file(name: str, tmp_path: Path) -> None:
    options = [p for p in cli.load_all()[name].params if isinstance(p, click.Option) and p.expose_value]
    values = {p.name: [_plausible(p)] if p.multiple else _plausible(p) for p in options}
    expected = {key: str(value) if type(value) is int else value for key, value in values.items()}
    lines = [f"{max(p.opts, key=len)[2:]} = {json.dumps(values[p.name])}" for p in options]
    assert read_config(_written(tmp_path, "\n".join([f"[{name}]", *lines])), cli.load_all(), name) == expected


@settings(deadline=None)
@given(st.binary(max_size=60) | damaged_text(_example()))
def test_fuzz(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    folder = tmp_path_factory.mktemp("config")
    complaint = ""
    try:
        (folder / "config.toml").write_bytes(content)
        read_config(folder / "config.toml", cli.load_all(), "mosaic")
    except InputError as error:
        complaint = str(error)
    finally:
        shutil.rmtree(folder)
    assert not complaint or complaint.startswith(f"{folder / 'config.toml'}: ")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_offered(rdstitch: Run, monkeypatch: pytest.MonkeyPatch, shell: str) -> None:
    monkeypatch.setenv("_RDSTITCH_COMPLETE", f"{shell}_source")
    monkeypatch.setattr("click.shell_completion.BashComplete._check_version", staticmethod(lambda: None))
    done = rdstitch()
    assert (done.status, "_RDSTITCH_COMPLETE" in done.out) == (0, True)
    assert f"_RDSTITCH_COMPLETE={shell}_source" in _DOCUMENT.read_text(encoding="utf-8")


def test_completion_knows_choices(rdstitch: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_RDSTITCH_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", "rdstitch mosaic --config nowhere.toml --blend fe")
    monkeypatch.setenv("COMP_CWORD", "5")
    assert rdstitch().out == "plain,feather\n"
