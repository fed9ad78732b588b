"""Accuracy on real data with a truth: one function per data set, SETS is the list of them.

`python -m bench accuracy` measures all and renews the section of docs/benchmarks.md; `python -m bench.accuracy husky plaza` prints some.
"""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from bench.table import Row, markdown

TITLE = "Accuracy on real data"
EXPLANATION = (
    "Position errors in metres against each data set's truth, with the settings named in `bench/`. Baseline: what the row names "
    "(dead reckoning, interpolation); value: ours, or what the bound is about. Sets that are not at hand are left out."
)
SHARED = Path(__file__).parents[2] / "shared/data"

SETS: Mapping[str, Callable[[], list[Row]]] = {}  # name -> rows; none where the data are not at hand


def rows() -> list[Row]:
    return [row for measure in SETS.values() for row in measure()]


if __name__ == "__main__":
    for name in sys.argv[1:] or SETS:
        print(markdown(name, EXPLANATION, SETS[name]()), flush=True)
