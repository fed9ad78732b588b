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
            help="pose@<t>, pose@<t>#cov, between@<a>,<b>, velocity@<t>, bias@<t>, landmark/<id>, earth, place@<t>, place/<id>, "
            "decision/<factor>; "
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
    about the axes of the map; places latitude, longitude (degrees), altitude (m). Between keyframes the odometry gives the shape. Exit code 1 if one of the names has no answer.
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
        return f"{answer.name}: {_earth(value) if answer.name.endswith('earth') else _decision(value)}"
    if isinstance(value[0], list):
        return "\n".join([f"{answer.name}:", *(" ".join(f"{x:13.6e}" for x in row) for row in value)])
    digits = 9 if "place" in answer.name else 6  # of degrees: 0.1 mm
    return f"{answer.name}: {' '.join(f'{x:z.{digits}f}' for x in value)}"


def _decision(told: dict[str, Any]) -> str:
    compared = f" ({told['statistic']:.6g} against {told['threshold']:.6g})" if told.get("threshold") else ""
    return f"{told['verdict']} by {told['stage']}/{told['reason']}{compared}: {told['detail']}"


def _earth(told: dict[str, Any]) -> str:
    """The covariance is for --json."""
    origin = "unknown" if told["origin"] is None else " ".join(f"{x:.9f}" for x in told["origin"])
    if told["map_T_earth"] is None:
        return f"not known yet: {told['why']}; origin {origin}"
    sure = "" if told["sigma_yaw"] is None else f" (sigma {told['sigma_yaw']:.6f})"
    numbers = " ".join(f"{x:z.6f}" for x in told["map_T_earth"])
    return f"the map's x axis points {told['yaw']:.6f} rad{sure} from east; map_T_earth {numbers}; origin {origin}"
