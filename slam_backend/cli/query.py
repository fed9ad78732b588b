"""`slam-backend query RUN NAME...`: poses at any stamp, covariances, landmarks and decisions of a finished run."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from ..core.query import Answer


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, as `replay` writes it.")],
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME...",
            help="pose@<t>, pose@<t>#cov, between@<a>,<b>, velocity@<t>, bias@<t>, landmark/<id>, decision/<factor>; "
            "<t>, <a>, <b>: <sec>.<nsec>, now (the last keyframe) or k<keyframe index>. "
            "map@<t>/ before any of them: as believed at t.",
        ),
    ],
    as_of: Annotated[
        str | None,
        typer.Option(
            metavar="T", help="As believed when everything up to T had been applied, and nothing later."
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="One object: names to numbers, null: unknown.")
    ] = False,
) -> None:
    """Ask a finished run by name.

    Poses are x y z qx qy qz qw of the robot in the map, `between` those of b in a; covariances 6x6 in ROS order, position first,
    about the axes of the map. Between keyframes the odometry gives the shape. Exit code 1 if one of the names has no answer.
    Earlier beliefs are found by a replay of the run's inputs, which must be where they were.
    """
    from ..core.query import PAST, answers
    from ..io.finished import FinishedRun

    then = [f"{PAST}{as_of}/{name}" if as_of and not name.startswith(PAST) else name for name in names]
    told = answers(then, FinishedRun(run))
    found = [replace(answer, name=name) for name, answer in zip(names, told, strict=True)]
    if as_json:
        typer.echo(json.dumps({answer.name: _plain(answer) for answer in found}))
    for answer in found:
        if answer.value is None:
            sys.stderr.write(f"{answer.name}: unknown: {answer.why}\n")
        elif not as_json:
            typer.echo(_line(answer))
    if any(answer.value is None for answer in found):
        raise typer.Exit(1)


def _plain(answer: "Answer") -> Any:
    value: Any = answer.value
    return value.tolist() if hasattr(value, "tolist") else value


def _line(answer: "Answer") -> str:
    """A matrix takes a line for each row."""
    value = _plain(answer)
    if isinstance(value, dict):
        compared = (
            f" ({value['statistic']:.6g} against {value['threshold']:.6g})" if value.get("threshold") else ""
        )
        return f"{answer.name}: {value['verdict']} by {value['stage']}/{value['reason']}{compared}: {value['detail']}"
    if isinstance(value[0], list):
        return "\n".join([f"{answer.name}:", *(" ".join(f"{x:13.6e}" for x in row) for row in value)])
    return f"{answer.name}: {' '.join(f'{x:z.6f}' for x in value)}"
