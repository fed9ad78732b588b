"""Run the benchmarks and write docs/benchmarks.md; with names, run only those and print."""

import platform
import sys
from importlib import import_module
from pathlib import Path

from bench.table import markdown
from slam_backend.io.replay import versions

BENCHES = (
    "decode",
    "overhead",
    "park",
    "final",
    "simulated",
    "filter",
    "solve",
    "query",
    "robust",
    "live",
    "journal",
    "crash",
    "soak",
)
PAGE = Path(__file__).parents[1] / "docs/benchmarks.md"
HEAD = """# Benchmarks

Written by `make bench`; do not edit. Times are CPU seconds on {machine}; machines differ and are noisy, so what counts is
the ratio to a baseline in the same run. Rows that need data which is not at hand are left out.

Versions: {versions}.
"""


def main(names: list[str]) -> int:
    sections = []
    holds = True
    for name in names or BENCHES:
        bench = import_module(f"bench.{name}")
        rows = bench.rows()
        holds = holds and all(row.holds for row in rows)
        section = markdown(bench.TITLE, bench.EXPLANATION, rows)
        print(section, flush=True)
        sections.append(section)
    if not names:
        found = versions()
        machine = f"a {found.pop('machine')} machine ({found.pop('cpu')}; {platform.system()})"
        head = HEAD.format(machine=machine, versions=", ".join(f"{k} {v}" for k, v in found.items()))
        PAGE.write_text("\n".join([head, *sections]), encoding="utf-8")
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
