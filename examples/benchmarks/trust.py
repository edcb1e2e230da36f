"""Is any result wrong that claims to be right? And how many of the solvable sets are solved?

``python -m examples.benchmarks.trust [--sets 300] [--kind pair]``; ``--kind adverse`` takes all adverse ones in turn,
``--keep FILE`` continues an earlier run. The last lines count the warnings that are printed, and those that are true: a
result that is off, or a set in which there is what the warning says.
"""

import json
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

from examples.benchmarks.driver import run
from examples.worlds.adverse_sets import ADVERSE, SOLVABLE_ADVERSE
from examples.worlds.trust_sets import HOPELESS, ODD, SOLVABLE, SPOILED, Judged, judge_set, trust_set

_SOLVABLE = (*SOLVABLE, *ODD, *SPOILED, *SOLVABLE_ADVERSE)
_TRUE_OF = {
    "damaged": ("bit rot", "spoiled"),
    "mixed-lenses": ("mixed lenses", "mixed by one", "spoiled"),
    "relief": ("cylinder",),
    "repeated-pattern": ("dirt", "repeated"),
    "rival-motion": ("vehicle", "body"),
    "seam-break": ("vehicle", "body", "bit rot", "spoiled"),
    "shape": ("off centre", "crops", "rolling shutter", "cylinder", "odd lens"),
    "static-background": ("body", "banner", "round border", "curved border"),
}
"""Kinds of sets in which there is what a warning of a code says."""

_OTHERS = (*HOPELESS, *(kind for kind in ADVERSE if kind not in SOLVABLE_ADVERSE))


def main(
    *, sets: int = 30, first: int = 0, kind: str | None = None, keep: Path | None = None, verbose: bool = False
) -> None:
    """Print every set that was not solved right, and the totals."""
    counts, warnings = Counter[tuple[str, str]](), Counter[tuple[str, bool]]()
    kept = _read(keep)
    start, done = time.process_time(), 0
    for seed in range(first, first + sets):
        judged = kept.get(seed)
        if judged is None:
            judged, done = _judge(seed, kind), done + 1
            if keep is not None:
                with keep.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps({"seed": seed, **asdict(judged)}) + "\n")
        what = _outcome(judged)
        silent, solved = what == "silently wrong", what == "solved"
        counts[judged.kind, what] += 1
        warnings.update((code, not judged.right or judged.kind in _TRUE_OF.get(code, ())) for code in judged.warnings)
        if silent or verbose or (judged.kind in _SOLVABLE and not solved):
            print(
                f"{seed} {judged.kind}: {what}, status {judged.status}, {judged.error:.2f} px: {judged.text[:230]}",
                flush=True,
            )
    columns = ("solved", "in part", "refused", "warned of", "silently wrong")
    print(f"\n{'kind':16}" + "".join(f"{name:>16}" for name in columns))
    for each in (*_SOLVABLE, *_OTHERS):
        print(f"{each:16}" + "".join(f"{counts[each, name]:16}" for name in columns))
    solvable = sum(count for (kind, _), count in counts.items() if kind in _SOLVABLE)
    share = sum(counts[kind, "solved"] for kind in _SOLVABLE) / max(solvable, 1)
    refused = sum(counts[kind, "refused"] for kind in _SOLVABLE) / max(solvable, 1)
    wrong = sum(counts[kind, "silently wrong"] for kind in (*_SOLVABLE, *_OTHERS))
    print(f"\n{share:.1%} of {solvable} solvable sets solved, {refused:.1%} refused; ", end="")
    print(f"{wrong} of {sets} sets silently wrong; ", end="")
    print(f"{(time.process_time() - start) / max(done, 1):.1f} s of processor time a set")
    codes = sorted({code for code, _ in warnings})
    print("true warnings: ", end="")
    print("; ".join(f"{warnings[c, True]} of {warnings[c, True] + warnings[c, False]} [{c}]" for c in codes) or "none")


def _outcome(judged: Judged) -> str:
    """What became of a set, in two words at most; one that is wrong is not silent where a warning names the place."""
    if judged.status:
        return "refused"
    if not judged.right:
        return "warned of" if judged.warned else "silently wrong"
    return "solved" if judged.complete else "in part"


def _judge(seed: int, kind: str | None) -> Judged:
    with TemporaryDirectory() as folder:
        return judge_set(trust_set(seed, ADVERSE[seed % len(ADVERSE)] if kind == "adverse" else kind), Path(folder))


def _read(file: Path | None) -> dict[int, Judged]:
    """What an earlier run has kept, by seed."""
    if file is None or not file.exists():
        return {}
    lines = map(json.loads, file.read_text(encoding="utf-8").splitlines())
    return {line.pop("seed"): Judged(**line) for line in lines}


if __name__ == "__main__":
    run(main)
