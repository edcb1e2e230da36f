"""README and docs: what they show is what commands print, what they link to exists, and the tutorial runs."""

import doctest
import re
import runpy
import tomllib
from pathlib import Path

import pytest
from PIL import Image
from rdstitch_cli.main import cli

from tests.documented_figures import MEASUREMENTS, README, ROOT, feature_row, readme, without_seconds

_PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_readme_shows_what_its_commands_print() -> None:
    # python -m tests.documented_figures --write
    assert without_seconds(readme()) == without_seconds(README.read_text(encoding="utf-8"))


@pytest.mark.parametrize("kind", ["rootsift", "orb"])
def test_features_are_as_their_table_says(kind: str) -> None:
    assert feature_row(kind) in MEASUREMENTS.read_text(encoding="utf-8")


def test_the_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs/tutorial.md").read_text(encoding="utf-8")
    code = "\n".join("" if line.startswith("```") else line for line in text.splitlines())
    test = doctest.DocTestParser().get_doctest(code + "\n", {}, "tutorial.md", "docs/tutorial.md", 0)
    assert len(test.examples) > 20
    printed: list[str] = []
    results = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=printed.append)
    assert results.failed == 0, "".join(printed)


@pytest.mark.parametrize("page", _PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if not target.startswith(("http:", "https:")):
            file, _, heading = target.partition("#")
            found = page.parent / file if file else page
            assert found.exists(), target
            if heading:
                words = heading.replace("-", "[- ]")
                assert re.search(rf"(?mi)^#+ {words}$", found.read_text(encoding="utf-8")), target


def test_readme_names_every_command_and_no_other() -> None:
    named = set(re.findall(r"`rdstitch ([a-z]+)", README.read_text(encoding="utf-8")))
    assert named == set(cli.load_all())


def test_every_page_is_in_the_site() -> None:
    listed = set(re.findall(r"(?m): ([a-z-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    assert listed == {page.name for page in (ROOT / "docs").glob("*.md")}


def test_version_is_the_same_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f"version: {project['version']}" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"## [{project['version']}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_python_of_readme_runs(tmp_path: Path, frames: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    (block,) = re.findall(r"(?ms)^```python\n(.*?)^```$", README.read_text(encoding="utf-8"))
    example = ROOT / "examples" / "readme.py"
    # There mypy checks it.
    assert example.read_text(encoding="utf-8").endswith(block)
    for name, frame in zip(("left", "right"), frames, strict=False):
        with Image.open(frame) as image:
            image.save(tmp_path / f"{name}.jpg")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(example))
    assert (tmp_path / "pano.png").exists()
