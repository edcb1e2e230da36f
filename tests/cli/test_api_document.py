"""docs/api.md: every public name has an example, and the examples run."""

import doctest
import inspect
import re
import shutil
from pathlib import Path

import pytest

import rdstitch
from rdstitch import solvers

_DOCUMENT = Path(__file__).parents[2] / "docs" / "api.md"


def _text() -> str:
    return _DOCUMENT.read_text(encoding="utf-8")


def _code() -> str:
    """The examples, and everything else as empty lines, so that a failure has the document's line number."""
    lines, inside = [], False
    for line in _text().splitlines():
        if line.startswith("```"):
            inside = line == "```pycon"
            lines.append("")
        else:
            lines.append(line if inside else "")
    return "\n".join(lines) + "\n"


def test_the_examples_run(frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "flight").mkdir()
    for name, frame in zip(("left", "middle", "right"), frames, strict=True):
        shutil.copy(frame, tmp_path / f"{name}.png")
        shutil.copy(frame, tmp_path / "flight")
    monkeypatch.chdir(tmp_path)
    test = doctest.DocTestParser().get_doctest(_code(), {}, "api.md", str(_DOCUMENT), 0)
    assert len(test.examples) > 40
    told: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL)
    results = runner.run(test, out=told.append)
    assert results.failed == 0, "".join(told)


@pytest.mark.parametrize("name", rdstitch.__all__)
def test_every_name_has_a_section_with_an_example(name: str) -> None:
    sections = re.split(r"(?m)^### ", _text())
    (section,) = (section for section in sections if f"`rdstitch.{name}`" in section.splitlines()[0])
    assert f"rdstitch.{name}" in re.split(r"```pycon", section, maxsplit=1)[1]
    assert inspect.getdoc(getattr(rdstitch, name))


@pytest.mark.parametrize("name", [name for name in solvers.__all__ if name[0].islower()])
def test_solvers_say_what_they_take_and_give(name: str) -> None:
    text = inspect.getdoc(getattr(solvers, name)) or ""
    assert re.search(r"Parameters\n|:func:", text)
    assert re.search(r"Returns\n|Solutions|:func:", text)


@pytest.mark.parametrize(
    "function", [getattr(rdstitch, name) for name in rdstitch.__all__ if inspect.isfunction(getattr(rdstitch, name))]
)
def test_public_functions_are_typed_and_described(function: object) -> None:
    assert callable(function)
    signature = inspect.signature(function)
    assert all(parameter.annotation is not inspect.Parameter.empty for parameter in signature.parameters.values())
    assert signature.return_annotation is not inspect.Signature.empty
    text = inspect.getdoc(function) or ""
    missing = [name for name in signature.parameters if not re.search(rf"\b{name}\b", text)]
    assert missing == []


@pytest.mark.parametrize("name", ["api", "sidecar", "camera-files", "configuration"])
def test_readme_points_to_the_references(name: str) -> None:
    assert _DOCUMENT.with_stem(name).exists()
    assert f"(docs/{name}.md)" in (_DOCUMENT.parents[1] / "README.md").read_text(encoding="utf-8")
