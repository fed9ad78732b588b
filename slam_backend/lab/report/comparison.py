"""The page that shows runs side by side."""

from collections.abc import Sequence
from pathlib import Path

from ...core.measurement import SECOND, format_stamp
from ..compare import NUMBERS, Compared, distances_to
from .page import Section, drawn, figure, html, line, said, table

COLOURS = ("#1f4e9c", "#d9822b", "#3c9a5f", "#8e44ad", "#c0392b", "#16a085", "#7f8c8d", "#b7950b")
FLIPS = 200  # shown of each run


def write_comparison(found: Sequence[Compared], out: Path) -> None:
    """One HTML file; the first of the runs is the base."""
    sections = [_numbers(found), _paths(found), _apart(found), *map(_flips, found[1:])]
    title = ", ".join(names(found))
    out.write_text(html(title, [section for section in sections if section is not None]), encoding="utf-8")


def names(found: Sequence[Compared]) -> list[str]:
    """Of the runs: the last part of their paths, or the whole where that does not tell them apart."""
    short = [each.run.path.resolve().name for each in found]
    return short if len(set(short)) == len(short) else [str(each.run.path) for each in found]


def rows(found: Sequence[Compared]) -> list[list[str]]:
    """A row for each number that is known, a column for each run."""
    told = [["run hash", *(_hash(each, n) for n, each in enumerate(found))]]
    for name, heading in NUMBERS.items():
        values = [each.numbers[name] for each in found]
        if any(value is not None for value in values):
            told.append([heading, *("-" if value is None else f"{value:.6g}" for value in values)])
    return [*told, ["solving time, ratio", *(f"{each.times:.2f}" if each.times else "-" for each in found)]]


def _hash(each: Compared, n: int) -> str:
    return "identical" if n and each.identical else str(each.run.summary["run_hash"])[:12]


def _numbers(found: Sequence[Compared]) -> Section:
    body = table(("", *names(found)), rows(found))
    settings = {name: each.settings[name][0] for each in found for name in each.settings}
    changed = [
        [name, *(str(each.settings.get(name, (was, was))[1]) for each in found)]
        for name, was in settings.items()
    ]
    if changed:
        body += said("Settings that differ:") + table(("setting", *names(found)), changed)
    return Section("Numbers", body)


def _paths(found: Sequence[Compared]) -> Section:
    lines = [
        line(
            name,
            COLOURS[n % len(COLOURS)],
            each.run.trajectory.sevens[:, 0],
            each.run.trajectory.sevens[:, 1],
        )
        for n, (name, each) in enumerate(zip(names(found), found, strict=True))
    ]
    return Section(
        "Trajectories", drawn("paths"), {"paths": figure(lines, "x (m)", "y (m)", equal=True, height=560)}
    )


def _apart(found: Sequence[Compared]) -> Section | None:
    base, lines, told = found[0].run, [], ""
    for n, (name, each) in enumerate(zip(names(found), found, strict=True)):
        if n == 0 or each.identical:
            continue
        seconds = (each.run.trajectory.stamps - base.trajectory.stamps[0]) / SECOND
        lines.append(line(name, COLOURS[n % len(COLOURS)], seconds, distances_to(base, each.run)))
        if each.parting:
            place = ", ".join(f"{value:.2f}" for value in each.parting.place)
            told += said(
                f"{name} parts at {format_stamp(each.parting.stamp)}, where the base is at ({place}) m."
            )
    if not lines:
        return None
    drawing = figure(lines, "time along the run (s)", "distance to the base (m)")
    return Section("Where they part", told + drawn("apart"), {"apart": drawing})


def _flips(each: Compared) -> Section | None:
    if not each.flips:
        return None
    shown = [(flip.id, flip.base, flip.verdict, flip.rule, flip.detail) for flip in each.flips[:FLIPS]]
    more = said(f"{len(each.flips) - FLIPS} more.") if len(each.flips) > FLIPS else ""
    head = ("measurement", "base", "here", "rule", "why")
    return Section(f"Decisions that flipped in {each.run.path.name}", table(head, shown) + more)
