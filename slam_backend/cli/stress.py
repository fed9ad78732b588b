"""`slam-backend stress RUN`: how many wrong loops a recorded run withstands, by strategy."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .progress import progress

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..lab.stress import Stress, Trial


def command(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="A run directory; its inputs must still be there.")
    ],
    wrong_loops: Annotated[
        str,
        typer.Option(metavar="P,P,...", help="Percentages of wrong loops among all, each below 100."),
    ] = "0,10,30,50,70",
    groups: Annotated[
        str,
        typer.Option(
            metavar="N,N,...",
            help="Sizes of groups of wrong loops that agree with each other; 1: single ones.",
        ),
    ] = "1",
    strategies: Annotated[
        list[str] | None,
        typer.Option(
            "--strategy",
            metavar="S",
            help="Stages joined by +, as gate+witness, or none; again for each. Default: as recorded, and none.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same wrong loops.")] = 0,
    tolerance: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            metavar="M",
            help="m (root mean square) that a map may be off from the recorded one. Default: a tenth of odometry's, at least 0.1.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Every trial as JSON.")] = False,
) -> None:
    """Put plausible wrong loops into a recorded run and report where its map breaks."""
    from ..io.finished import FinishedRun
    from ..lab.stress import NONE, Stress, configured, sentences

    recorded = FinishedRun(run)
    stress = Stress(recorded, seed, tolerance)
    names = list(dict.fromkeys(strategies or (stress.recorded, NONE)))
    for name in names:
        configured(recorded.config, name)  # a misspelt one is said before hours of work
    shares = [percent / 100 for percent in _numbers(wrong_loops, "--wrong-loops", 0, 99)]
    sizes = _numbers(groups, "--groups", 1, 100)
    trials = _tried(stress, names, shares, sizes)
    said = sentences(trials)
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "run": str(run),
                    "tolerance": stress.tolerance,
                    "seed": seed,
                    "trials": [trial.plain() for trial in trials],
                    "verdicts": said,
                }
            )
        )
        return
    _show(trials, sizes)
    typer.echo(f"broken: more than {stress.tolerance:.3g} m (root mean square) from the recorded map")
    for name, sentence in said.items():
        typer.echo(f"{name}: {sentence}")


def _tried(stress: "Stress", names: list[str], shares: list[float], sizes: list[int]) -> "list[Trial]":
    plan = [(name, share, size) for name in names for size in sizes for share in shares]
    with progress("stress", stress.count * len(plan)) as advance:
        return [stress.trial(*each, advance) for each in plan]


def _show(trials: "Sequence[Trial]", sizes: list[int]) -> None:
    from .evaluate import columns

    head = [
        "strategy",
        "wrong loops",
        "in groups of",
        "off, m",
        "map",
        "true kept",
        "wrong kept",
        "at any moment",
        "s",
    ]
    rows = [
        [
            t.strategy, f"{t.share:.0%}", str(t.size), f"{t.off:.3f}", "broken" if t.broken else "whole",
            f"{t.true}/{t.true_offered}", f"{t.wrong}/{t.wrong_offered}", str(t.ever), f"{t.seconds:.1f}",
        ]
        for t in trials
    ]  # fmt: skip
    drop = 2 if sizes == [1] else None
    for line in columns([[cell for n, cell in enumerate(row) if n != drop] for row in [head, *rows]]):
        typer.echo(line)


def _numbers(text: str, option: str, least: int, most: int) -> list[int]:
    """A list of whole numbers; a mistake is one line."""
    words = [word.strip().removesuffix("%") for word in text.split(",")]
    if bad := [
        word for word in words if not (word.isascii() and word.isdigit() and least <= int(word) <= most)
    ]:
        raise typer.BadParameter(f"{option} {text}: '{bad[0]}' is no whole number from {least} to {most}")
    return sorted({int(word) for word in words})
