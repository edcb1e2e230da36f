"""Is any result wrong that claims to be right? And how many of the solvable sets are solved?

python -m tests.benchmarks.trust [--sets 300] [--first 0] [--kind pair]
"""

import argparse
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.trust_sets import HOPELESS, SOLVABLE, judge_set, trust_set


def main() -> None:
    """Print every set that was not solved right, and the totals."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=30, help="number of random sets")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--kind", choices=(*SOLVABLE, *HOPELESS), help="only sets of this kind")
    parser.add_argument("--verbose", action="store_true", help="one line for every set")
    wanted = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    start = time.process_time()
    for seed in range(wanted.first, wanted.first + wanted.sets):
        item = trust_set(seed, wanted.kind)
        with TemporaryDirectory() as folder:
            judged = judge_set(item, Path(folder))
        silent = judged.status == 0 and not judged.right
        solved = judged.status == 0 and judged.right and judged.complete
        what = "silently wrong" if silent else "solved" if solved else "in part" if judged.status == 0 else "refused"
        counts[item.kind, what] += 1
        if silent or wanted.verbose or (item.kind in SOLVABLE and not solved):
            print(
                f"{seed} {item.kind}: {what}, status {judged.status}, {judged.error:.2f} px: {judged.text[:230]}",
                flush=True,
            )
    columns = ("solved", "in part", "refused", "silently wrong")
    print(f"\n{'kind':16}" + "".join(f"{name:>16}" for name in columns))
    for kind in (*SOLVABLE, *HOPELESS):
        print(f"{kind:16}" + "".join(f"{counts[kind, name]:16}" for name in columns))
    solvable = sum(count for (kind, _), count in counts.items() if kind in SOLVABLE)
    share = sum(counts[kind, "solved"] for kind in SOLVABLE) / max(solvable, 1)
    wrong = sum(counts[kind, "silently wrong"] for kind in (*SOLVABLE, *HOPELESS))
    print(f"\n{share:.1%} of {solvable} solvable sets solved; {wrong} of {wanted.sets} sets silently wrong; ", end="")
    print(f"{(time.process_time() - start) / wanted.sets:.1f} s of processor time a set")


if __name__ == "__main__":
    main()
