"""Run the benchmarks and write docs/benchmarks.md; with names, run only those and renew their sections."""

import platform
import re
import sys
from importlib import import_module
from pathlib import Path

from bench.table import markdown
from slam_backend.io.result import versions

BENCHES = (
    "decode",
    "overhead",
    "park",
    "sensors",
    "final",
    "simulated",
    "crowd",
    "filter",
    "solve",
    "query",
    "report",
    "robust",
    "accuracy",
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
    known = [import_module(f"bench.{name}") for name in BENCHES]
    holds = True
    for bench in [import_module(f"bench.{name}") for name in names] or known:
        rows = bench.rows()
        holds = holds and all(row.holds for row in rows)
        section = markdown(bench.TITLE, bench.EXPLANATION, rows)
        print(section, flush=True)
        write(
            {**written(), bench.TITLE: section}, [each.TITLE for each in known]
        )  # what is measured stays, whatever ends the next one
    return 0 if holds else 1


def written() -> dict[str, str]:
    """The sections of the page, by title."""
    text = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    parts = re.split(r"^(?=## )", text, flags=re.MULTILINE)[1:]
    return {part.partition("\n")[0].removeprefix("## "): part.rstrip() + "\n" for part in parts}


def write(sections: dict[str, str], titles: list[str]) -> None:
    """The page anew, in the order of the table."""
    found = versions()
    machine = f"a {found.pop('machine')} machine ({found.pop('cpu')}; {platform.system()})"
    head = HEAD.format(machine=machine, versions=", ".join(f"{k} {v}" for k, v in found.items()))
    PAGE.write_text(
        "\n".join([head, *(sections[title] for title in titles if title in sections)]), encoding="utf-8"
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
