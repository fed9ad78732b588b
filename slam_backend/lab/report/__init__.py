"""report.html: one page, with everything in it, that answers what a person asks of a run.

Each section is a file with a function `section(run)`; one that has no data gives None, and is absent.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from . import (
    convergence,
    drift,
    earth,
    health,
    loops,
    neighbours,
    playback,
    residuals,
    sparsity,
    summary,
    timing,
    trajectory,
    unguarded,
)
from .page import Section, html
from .subject import Subject

REPORT = "report.html"
SECTIONS: Sequence[Callable[[Subject], Section | None]] = (
    summary.section,
    trajectory.section,
    playback.section,
    loops.section,
    unguarded.section,
    drift.section,
    earth.section,
    residuals.section,
    neighbours.section,
    convergence.section,
    sparsity.section,
    timing.section,
    health.section,
)


def write_report(run: Subject, out: Path) -> None:
    """Write the page. BadFile if a file of the run is missing or damaged."""
    sections = [section for make in SECTIONS if (section := make(run)) is not None]
    out.write_text(html(summary.title(run), sections), encoding="utf-8")
