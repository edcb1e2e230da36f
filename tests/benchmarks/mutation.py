"""Do the tests notice when a decision is changed? Small changes of the code, one at a time, each against its tests.

    python -m tests.benchmarks.mutation                         # of every module of MAPPED, a sample of 10 mutants
    python -m tests.benchmarks.mutation robust.verification --sample 0      # all mutants of one module

A mutant is the module with one operator or constant changed; nothing on disk is touched. It is killed when one of the
tests that the module is mapped to fails, or takes far longer than without the change. Those that survive are printed.
"""

import argparse
import ast
import os
import random
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

# Tests by module, or by package for those of its modules that are not named; the quickest to fail first.
MAPPED = {
    "robust": (
        "unit/robust/test_sampling.py",
        "unit/robust/test_pair_models.py",
        "unit/robust/test_decisions.py",
        "unit/robust/test_own_lenses.py",
        "acceptance/test_robust_estimation.py",
    ),
    "verification": ("unit/verification", "property/test_trust.py"),
    "matching.candidate_pairs": ("unit/matching/test_candidate_pairs.py", "unit/matching/test_two_view_rounds.py"),
    "matching.distortion_consensus": ("unit/matching/test_distortion_consensus.py",),
    "matching.lens_votes": ("unit/matching/test_mixed_lenses.py",),
    "matching.match_graph": ("unit/matching/test_match_graph.py",),
    "matching.mixed_lenses": ("unit/matching/test_mixed_lenses.py",),
    "matching.static_background": ("unit/matching/test_static_background.py", "unit/matching/test_two_view_rounds.py"),
    "matching.thinning": ("unit/matching/test_thinning.py",),
    "alignment.cycle_consistency": ("unit/alignment/test_cycle_consistency.py", "unit/alignment/test_align.py"),
    "alignment.model_selection": ("unit/alignment/test_align.py",),
    "alignment.planarity": ("unit/alignment/test_planarity.py", "unit/alignment/test_align.py"),
}

# Numbers that decide nothing: changed, the same comes out, only sooner or later, or in other steps.
SPEED_ONLY = frozenset(
    ("_BLOCK", "_CHUNK", "_FIRST_BATCH", "_LARGEST_BATCH", "_QUICK_SCORE", "_MOST_TRIANGLES", "_LATTICE", "_TRAINING")
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
    """

    module: str
    number: int
    line: int
    change: str

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
    return [Mutant(module, k, change.node.lineno, change.text) for k, change in enumerate(_changes(tree))]


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


def survives(mutant: Mutant | None, tests: Sequence[str], seconds: float) -> bool:
    """Whether all tests pass, in time, in a process of their own; without a mutant, as the code is."""
    child = os.fork()
    if not child:
        _run(mutant, tests)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) == 0
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def _run(mutant: Mutant | None, tests: Sequence[str]) -> None:
    """Run the tests and leave; everything that they print is lost."""
    os.setsid()
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    status = 1
    try:
        import pytest

        if mutant is not None:
            sys.meta_path.insert(0, _Importer(mutant))
        status = int(
            pytest.main(["-x", "-q", "-p", "no:cacheprovider", *(str(ROOT / "tests" / test) for test in tests)])
        )
    finally:
        os._exit(status)


def _modules(wanted: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The modules named, or all that are mapped, and the tests of each: those of its name first."""
    found = {}
    for name, tests in MAPPED.items():
        package = ROOT / "rdstitch" / name.replace(".", "/")
        parts = [f"{name}.{p.stem}" for p in sorted(package.glob("[!_]*.py"))] if package.is_dir() else [name]
        for module in parts:
            own = f"unit/{module.replace('.', '/test_').replace('/test_', '/', module.count('.') - 1)}.py"
            first = (own,) if own not in tests and (ROOT / "tests" / own).exists() else ()
            if not wanted or any(module == part or module.startswith(f"{part}.") for part in wanted):
                found[module] = (*first, *tests)
    return found


def main() -> int:
    """Print the survivors, and the share of each module's mutants that survived."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.mutation", description="Do tests notice changed decisions?"
    )
    parser.add_argument("modules", nargs="*", help="below rdstitch, as robust or matching.thinning; all mapped ones")
    parser.add_argument("--sample", type=int, default=10, help="mutants of each module; 0 is all of them")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--workers", type=int, default=1, help="mutants tested at a time")
    arguments = parser.parse_args()
    # Loaded once, before the processes of the mutants divide; nothing of rdstitch itself.
    import cv2  # noqa: F401
    import pytest  # noqa: F401
    import scipy.optimize
    import scipy.sparse.csgraph  # noqa: F401

    total, lost = 0, 0
    with ThreadPoolExecutor(arguments.workers) as pool:
        for module, tests in _modules(arguments.modules).items():
            chosen = mutants(module)
            if 0 < arguments.sample < len(chosen):
                chosen = random.Random(f"{arguments.seed} {module}").sample(chosen, arguments.sample)
            start = time.monotonic()
            if not survives(None, tests, 600.0):
                print(f"{module}: its tests fail as the code is: {' '.join(tests)}")
                return 1
            seconds = 10.0 + 5.0 * (time.monotonic() - start)
            alive = list(pool.map(partial(survives, tests=tests, seconds=seconds), chosen))
            survivors = [mutant for mutant, lives in zip(chosen, alive, strict=True) if lives]
            total, lost = total + len(chosen), lost + len(survivors)
            print(f"{module}: {len(survivors)} of {len(chosen)} survive", *survivors, sep="\n  ", flush=True)
    print(f"{lost} of {total} mutants survive ({lost / max(total, 1):.0%})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
