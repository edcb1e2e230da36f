"""Do the tests notice when a decision is changed? Small changes of the code, one at a time, each against its tests.

    python -m tests.benchmarks.mutation                             # a sample of 7 mutants of every module of MODULES
    python -m tests.benchmarks.mutation robust.verification --sample 0      # all mutants of one module

A mutant is the module with one operator or constant changed; nothing on disk is touched. First the tests of TESTS run
once, to see which of them executes which lines. A mutant then meets the tests that execute its line, the quickest
first, as long as these take no more than ``--seconds``; it is killed when one fails, or takes far longer than without
the change. Those that survive are printed.
"""

import argparse
import ast
import json
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

# Packages and modules that decide; of a package all modules but those that only describe.
MODULES = (
    "robust",
    "verification",
    "matching.candidate_pairs",
    "matching.distortion_consensus",
    "matching.lens_votes",
    "matching.match_graph",
    "matching.mixed_lenses",
    "matching.static_background",
    "matching.thinning",
    "alignment.cycle_consistency",
    "alignment.lens_selection",
    "alignment.model_selection",
    "alignment.noise_model",
    "alignment.planarity",
    "alignment.turn_or_plane",
)
TESTS = ("unit/robust", "unit/verification", "unit/matching", "unit/alignment")

# Numbers that decide nothing: changed, the same comes out, only sooner or later, or in other steps.
SPEED_ONLY = frozenset(
    ("_BLOCK", "_CHUNK", "_FIRST_BATCH", "_MAX_BATCH", "_QUICK_SCORE", "_MAX_TRIANGLES", "_LATTICE", "_TRAINING")
)
_COUNT = 8  # from which on one more of something would make no difference
_SMALLEST = 1e-5  # numbers below keep divisions and logarithms finite

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Pow: ast.Mult, ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One change of one module.

    Attributes
    ----------
    module : str
        Below ``rdstitch``.
    number : int
        Which change of the module, in the order of its text.
    line : int
    change : str
    lines : frozenset of int
        Of the statement; empty for one that is executed when the module is imported.
    """

    module: str
    number: int
    line: int
    change: str
    lines: frozenset[int] = frozenset()

    def __str__(self) -> str:
        """Where, and what."""
        return f"{_path(self.module).relative_to(ROOT)}:{self.line}: {self.change}"


@dataclass(frozen=True)
class _Change:
    """A change of a syntax tree that has not been made yet."""

    node: ast.expr
    text: str
    make: Callable[[], None]


def _path(module: str) -> Path:
    return ROOT / "rdstitch" / f"{module.replace('.', '/')}.py"


def _changes(tree: ast.AST) -> list[_Change]:
    """All changes of a tree, in the order of its text."""
    found = [change for node in _expressions(tree) for change in _changes_of(node)]
    return sorted(found, key=lambda change: (change.node.lineno, change.node.col_offset, change.text))


def _expressions(node: ast.AST) -> Iterator[ast.expr]:
    """The expressions that are evaluated: no annotations, and no numbers that only cost time."""
    if isinstance(node, ast.expr):
        yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "type_params", "decorator_list") or isinstance(node, ast.JoinedStr):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.Assign) and any(
                isinstance(target, ast.Name) and target.id in SPEED_ONLY for target in child.targets
            ):
                continue
            if isinstance(child, ast.keyword) and child.arg == "strict":  # of zip: a safeguard
                continue
            if isinstance(child, ast.AST):
                yield from _expressions(child)


def _changes_of(node: ast.expr) -> Iterator[_Change]:
    before = ast.unparse(node)

    def change(field: str, value: Any) -> _Change:
        original = getattr(node, field)
        setattr(node, field, value)
        text = f"{before}  →  {ast.unparse(node)}"
        setattr(node, field, original)
        return _Change(node, text, partial(setattr, node, field, value))

    if isinstance(node, ast.Compare):
        for index, operator in enumerate(node.ops):
            yield change("ops", [*node.ops[:index], _COMPARISONS[type(operator)](), *node.ops[index + 1 :]])
    elif isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
        yield change("op", _ARITHMETIC[type(node.op)]())
    elif isinstance(node, ast.BoolOp):
        yield change("op", ast.Or() if isinstance(node.op, ast.And) else ast.And())
    elif isinstance(node, ast.UnaryOp):
        yield change("operand", ast.UnaryOp(node.op, node.operand))
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield change("value", not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int):
        yield change("value", node.value + 1 if node.value < _COUNT else 3 * node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, float) and node.value >= _SMALLEST:
        yield change("value", 3.0 * node.value)


def mutants(module: str) -> list[Mutant]:
    """All mutants of a module."""
    tree = ast.parse(_path(module).read_text(encoding="utf-8"))
    lines = _statement_lines(tree)
    return [
        Mutant(module, k, change.node.lineno, change.text, lines.get(change.node.lineno, frozenset()))
        for k, change in enumerate(_changes(tree))
    ]


def _statement_lines(tree: ast.Module) -> dict[int, frozenset[int]]:
    """For each line of a function's body the lines of its statement; of a compound one, those of its head."""
    found: dict[int, frozenset[int]] = {}
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        for node in (inner for statement in function.body for inner in ast.walk(statement)):
            if isinstance(node, ast.stmt):
                body = getattr(node, "body", None)
                last = body[0].lineno - 1 if body else node.end_lineno or node.lineno
                lines = frozenset(range(node.lineno, max(last, node.lineno) + 1))
                found.update(dict.fromkeys(lines, lines))
    return found


class _Importer(SourceFileLoader):
    """Imports one module with one change."""

    def __init__(self, mutant: Mutant) -> None:
        SourceFileLoader.__init__(self, f"rdstitch.{mutant.module}", str(_path(mutant.module)))
        self._number = mutant.number

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname, path, target) if fullname == self.name else None
        if spec is not None:
            spec.loader = self
        return spec

    def get_code(self, fullname: str) -> CodeType:
        tree = ast.parse(_path(fullname.removeprefix("rdstitch.")).read_text(encoding="utf-8"))
        _changes(tree)[self._number].make()
        return compile(ast.fix_missing_locations(tree), self.path, "exec")


@dataclass(frozen=True)
class Coverage:
    """Which test executes what.

    Attributes
    ----------
    seconds : dict of str to float
        Of each test, by its identifier.
    lines : dict of str to set of (str, int)
        Module and line, of each test.
    """

    seconds: dict[str, float]
    lines: dict[str, set[tuple[str, int]]]

    def tests(self, mutant: "Mutant", budget: float) -> list[str]:
        """Those that execute the lines of a mutant, the quickest first, together in so many seconds."""
        wanted, own = mutant.lines, f"/test_{mutant.module.rpartition('.')[2]}.py::"
        found = [
            test
            for test, executed in self.lines.items()
            if (not wanted and own in test)
            or any(module == mutant.module and (not wanted or line in wanted) for module, line in executed)
        ]
        result: list[str] = []
        for test in sorted(found, key=lambda test: self.seconds[test]):
            budget -= self.seconds[test]
            if result and budget < 0.0:
                break
            result.append(test)
        return result


class _Tracer:
    """A plugin of pytest that notes what each test executes of the modules; what fixtures execute is every test's."""

    def __init__(self, modules: Sequence[str]) -> None:
        self._modules = {str(_path(module)): module for module in modules}
        self._lines: set[tuple[str, int]] = set()
        self._of_fixtures: dict[str, set[tuple[str, int]]] = {}
        self.found = Coverage({}, {})

    def _enter(self, frame: FrameType, event: str, argument: object) -> Any:
        module = self._modules.get(frame.f_code.co_filename)
        if module is None:
            return None

        def line(frame: FrameType, event: str, argument: object) -> Any:
            self._lines.add((module, frame.f_lineno))
            return line

        return line

    def pytest_runtest_logreport(self, report: Any) -> None:
        """After a phase of a test."""
        test, file = report.nodeid, report.nodeid.split("::")[0]
        if report.when == "setup":
            self._of_fixtures.setdefault(file, set()).update(self._lines)
        elif report.when == "call":
            self.found.seconds[test] = report.duration
            self.found.lines[test] = self._lines | self._of_fixtures[file]
        self._lines = set()

    def __enter__(self) -> "_Tracer":
        """Begin to trace."""
        threading.settrace(self._enter)
        sys.settrace(self._enter)
        return self

    def __exit__(self, *_: object) -> None:
        """End tracing."""
        sys.settrace(None)
        threading.settrace(None)


def measure_coverage(modules: Sequence[str], tests: Sequence[str], file: Path) -> Coverage:
    """Run all tests once, in a process of their own, as the code is; a file that is there is read instead."""
    if not file.exists():
        child = os.fork()
        if not child:
            _alone(partial(_trace, modules, tests, file))
        _, status = os.waitpid(child, 0)
        if os.waitstatus_to_exitcode(status) != 0:
            raise SystemExit(f"the tests fail as the code is: {' '.join(tests)}")
    seconds, lines = json.loads(file.read_text(encoding="utf-8"))
    return Coverage(seconds, {test: {(module, line) for module, line in found} for test, found in lines.items()})


def _trace(modules: Sequence[str], tests: Sequence[str], file: Path) -> int:
    import pytest

    with _Tracer(modules) as tracer:
        status = int(pytest.main([*_QUIET, *(str(ROOT / "tests" / test) for test in tests)], [tracer]))
    if status == 0:
        found = tracer.found
        text = json.dumps((found.seconds, {test: sorted(lines) for test, lines in found.lines.items()}))
        file.write_text(text, encoding="utf-8")
    return status


def survives(mutant: "Mutant", coverage: Coverage, budget: float) -> bool:
    """Whether all tests of a mutant pass, in time, in a process of their own."""
    tests = coverage.tests(mutant, budget)
    if not tests:
        return True
    child = os.fork()
    if not child:
        _alone(partial(_test, mutant, tests))
    end = time.monotonic() + 20.0 + 8.0 * sum(coverage.seconds[test] for test in tests)
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) == 0
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def _test(mutant: "Mutant", tests: Sequence[str]) -> int:
    import pytest

    sys.meta_path.insert(0, _Importer(mutant))
    return int(pytest.main([*_QUIET, *tests]))


_QUIET = ("-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--rootdir", str(ROOT))


def _alone(run: Callable[[], int]) -> None:
    """Run, in a forked process, and leave; everything that is printed is lost."""
    os.setsid()
    os.chdir(ROOT)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    status = 1
    try:
        status = run()
    finally:
        os._exit(status)


def _modules(wanted: Sequence[str]) -> list[str]:
    """The modules named, or all of MODULES."""
    found = []
    for name in MODULES:
        package = ROOT / "rdstitch" / name.replace(".", "/")
        found += [f"{name}.{p.stem}" for p in sorted(package.glob("[!_]*.py"))] if package.is_dir() else [name]
    return [m for m in found if not wanted or any(m == part or m.startswith(f"{part}.") for part in wanted)]


def main() -> int:
    """Print the survivors, and the share of each module's mutants that survived."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.mutation", description="Do tests notice changed decisions?"
    )
    parser.add_argument("modules", nargs="*", help="below rdstitch, as robust or matching.thinning; all of MODULES")
    parser.add_argument("--sample", type=int, default=7, help="mutants of each module; 0 is all of them")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--seconds", type=float, default=20.0, help="of tests that each mutant meets")
    parser.add_argument("--workers", type=int, default=1, help="mutants tested at a time")
    parser.add_argument("--coverage", type=Path, help="file that keeps what the tests execute, from run to run")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="below tests")
    arguments = parser.parse_args()
    # Loaded once, before the processes of the mutants divide; nothing of rdstitch itself.
    import cv2  # noqa: F401
    import pytest  # noqa: F401
    import scipy.optimize
    import scipy.sparse.csgraph
    import scipy.spatial  # noqa: F401

    modules = _modules(arguments.modules)
    with tempfile.TemporaryDirectory() as folder:
        coverage = measure_coverage(modules, arguments.tests, arguments.coverage or Path(folder) / "coverage.json")
    total, lost = 0, 0
    with ThreadPoolExecutor(arguments.workers) as pool:
        for module in modules:
            chosen = mutants(module)
            if 0 < arguments.sample < len(chosen):
                chosen = random.Random(f"{arguments.seed} {module}").sample(chosen, arguments.sample)
            alive = list(pool.map(partial(survives, coverage=coverage, budget=arguments.seconds), chosen))
            survivors = [mutant for mutant, lives in zip(chosen, alive, strict=True) if lives]
            total, lost = total + len(chosen), lost + len(survivors)
            print(f"{module}: {len(survivors)} of {len(chosen)} survive", *survivors, sep="\n  ", flush=True)
    print(f"{lost} of {total} mutants survive ({lost / max(total, 1):.0%})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
