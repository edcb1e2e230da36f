"""Every function fits one screen, and every file is one thing."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted([*(ROOT / "rdstitch").rglob("*.py"), *(ROOT / "cli").rglob("*.py")])
MAX_FILE = 350  # lines
MAX_FUNCTION = 60  # lines of code: without docstring, comments and empty lines


def _code_lines(function: ast.FunctionDef, text: list[str]) -> int:
    docstring: set[int] = set()
    if ast.get_docstring(function) is not None:
        first = function.body[0]
        docstring = set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    lines = (n for n in range(function.lineno, (function.end_lineno or 0) + 1) if n not in docstring)
    return sum(not text[n - 1].lstrip().startswith("#") and bool(text[n - 1].strip()) for n in lines)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_files_and_functions_are_short(path: Path) -> None:
    text = path.read_text(encoding="utf-8").splitlines()
    functions = [node for node in ast.walk(ast.parse("\n".join(text))) if isinstance(node, ast.FunctionDef)]
    assert len(text) <= MAX_FILE
    assert [f.name for f in functions if _code_lines(f, text) > MAX_FUNCTION] == []


def test_nothing_is_longer_than_it_seems() -> None:
    source = 'def f(\n    a: int,\n) -> int:\n    """Docs.\n\n    More.\n    """\n    # why\n\n    return a\n'
    (function,) = ast.parse(source).body
    assert isinstance(function, ast.FunctionDef)
    assert _code_lines(function, source.splitlines()) == 4
