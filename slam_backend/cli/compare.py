"""`slam-backend compare RUN RUN...`: what differs between runs, with an exit code for scripts."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..lab.compare import Compared

LONGEST = 16  # letters of a name over a column
SHOWN = 5  # decisions of each run; --json and --html have more


def command(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN...", help="Run directories; the first is the base.")
    ],
    truth: Annotated[
        Path | None, typer.Option(metavar="F", help="As of `evaluate`: adds ATE and RPE to the numbers.")
    ] = None,
    topic: Annotated[str, typer.Option(metavar="T", help="Of a truth that is a bag.")] = "",
    apart: Annotated[
        float, typer.Option(min=0.0, metavar="M", help="m between two trajectories from which on they part.")
    ] = 0.1,
    fail_if: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CONDITION",
            help="Exit with 1 if it holds for a run: 'ate > 1.05 * base', 'flips > 0 or cost > 2 * base.cost'.",
        ),
    ] = None,
    html: Annotated[
        Path | None, typer.Option(metavar="F", help="Write the comparison as a page, too.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Everything as JSON.")] = False,
) -> None:
    """Compare runs of one drive: numbers, settings, decisions that flipped, where the trajectories part.

    Exit code 1 if a condition of --fail-if holds for any run but the base.
    """
    from ..core.errors import BadConfig
    from ..io.finished import FinishedRun
    from ..lab.compare import NUMBERS, compare
    from ..lab.condition import Condition
    from ..lab.report.comparison import names, write_comparison
    from ..lab.truth import load_truth

    if len(runs) < 2:
        raise BadConfig("compare needs two runs or more: name the base and what to compare with it")
    conditions = [Condition(text, NUMBERS) for text in fail_if or ()]
    known = load_truth(truth, topic) if truth else None
    found = compare([FinishedRun(path) for path in runs], known, threshold=apart)
    if html:
        write_comparison(found, html)
    if as_json:
        typer.echo(json.dumps([as_plain(each) for each in found]))
    else:
        show(found)
    failed = [
        f"{name}: {condition.text}"
        for name, each in list(zip(names(found), found, strict=True))[1:]
        for condition in conditions
        if condition.holds(each.numbers, found[0].numbers)
    ]
    for line in failed:
        sys.stderr.write(f"failed: {line}\n")
    if failed:
        raise typer.Exit(1)


def show(found: "Sequence[Compared]") -> None:
    """The table, and a line for each thing that differs."""
    from ..core.measurement import format_stamp
    from ..lab.report.comparison import names, rows
    from .evaluate import columns

    labels = names(found)
    if max(map(len, labels)) > LONGEST:
        labels = [f"#{n}" for n in range(len(found))]
        for label, name in zip(labels, names(found), strict=True):
            typer.echo(f"{label}  {name}")
    for line in columns([["", *labels], *rows(found)]):
        typer.echo(line)
    for name, each in list(zip(labels, found, strict=True))[1:]:
        if each.identical:
            typer.echo(f"{name}: identical")
            continue
        for setting, (before, here) in each.settings.items():
            typer.echo(f"{name}: {setting}: {here} instead of {before}")
        if each.parting:
            place = ", ".join(f"{value:.2f}" for value in each.parting.place)
            typer.echo(
                f"{name}: parts at {format_stamp(each.parting.stamp)}, where the base is at ({place}) m"
            )
        for flip in each.flips[:SHOWN]:
            typer.echo(
                f"{name}: {flip.id}: {flip.verdict} instead of {flip.base}: {flip.rule}: {flip.detail}"
            )
        if len(each.flips) > SHOWN:
            typer.echo(f"{name}: {len(each.flips) - SHOWN} more decisions flipped")


def as_plain(each: "Compared") -> dict[str, Any]:
    from ..core.measurement import format_stamp

    parting = each.parting
    return {
        "run": str(each.run.path),
        "run_hash": each.run.summary["run_hash"],
        "identical": each.identical,
        "numbers": dict(each.numbers),
        "time_ratio": each.times,
        "settings": {name: list(pair) for name, pair in each.settings.items()},
        "parting": {"stamp": format_stamp(parting.stamp), "place": parting.place} if parting else None,
        "flips": [flip._asdict() for flip in each.flips],
    }
