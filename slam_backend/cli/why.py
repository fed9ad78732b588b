"""`slam-backend why RUN LOOP`: why a loop is in the graph or not, what it would take, what difference it makes."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from .progress import progress

SHOWN = 5  # ids in a line


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, as `replay` writes it.")],
    loop: Annotated[
        str,
        typer.Argument(
            metavar="LOOP", help="Its id, as in decisions.jsonl; or i-j, the vertices of a graph file."
        ),
    ],
    quick: Annotated[
        bool,
        typer.Option("--quick", help="Only what was decided: do not replay for what difference it makes."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
) -> None:
    """Why a loop was accepted or refused: distance and threshold, the path and the loops it was held against, what would let it pass.

    Its cost and the largest shift of a pose that it makes come from a replay of the run's inputs.
    """
    from ..io.finished import FinishedRun
    from ..io.why import difference, life
    from .replay import watch

    finished = FinishedRun(run)
    about = life(finished, loop)
    told: dict[str, Any] = {**about[-1], "life": [_step(line) for line in about]}
    if not quick:
        again = finished.again()
        watch(again, [], progress)
        finished.compare(again)
        told |= difference(again, told["id"])
    typer.echo(json.dumps(told) if as_json else "\n".join(_lines(told)))


def _step(line: Mapping[str, Any]) -> dict[str, str]:
    return {"verdict": line["verdict"], "rule": f"{line['stage']}/{line['reason']}", "detail": line["detail"]}


def _lines(told: Mapping[str, Any]) -> list[str]:
    ends = f" from {told['a']} to {told['b']}" if "a" in told else ""
    vertices = " (vertices {} and {})".format(*told["vertices"]) if "vertices" in told else ""
    lines = [f"{told['id']}{ends}{vertices}"]
    lines += [f"  {step['verdict']} by {step['rule']}: {step['detail']}" for step in told["life"]]
    if told.get("threshold") is not None:
        lines.append(f"  compared: {told['statistic']:.6g} against {told['threshold']:.6g}")
    basis = told.get("basis", {})
    if "limit" in basis:
        lines.append(f"  distance: chi-square {basis['distance']:.6g}, the gate ends at {basis['limit']:.6g}")
        lines.append(
            f"  path: {basis['path_m']:.4g} m of odometry{_ids(', by way of ', basis['via'])}; sure to {basis['sure_m']:.3g} m"
        )
    for name, words in WORDS.items():
        if basis.get(name):
            lines.append(_ids(f"  {words}: ", basis[name]))
    if "cost_with" in told:
        shift = told["largest_shift"]
        lines.append(f"  cost: {told['cost_with']:.6g} with it, {told['cost_without']:.6g} without")
        lines.append(f"  largest shift of a pose that it makes: {shift['m']:.4g} m, {shift['rad']:.4g} rad")
    if "weight" in told:
        lines.append(f"  in the graph: chi-square {told['residual_chi2']:.4g}, weight {told['weight']:.4g}")
    return lines


WORDS = {
    "clique": "agree with each other",
    "against": "contradict it",
    "agree": "agree with it",
    "absent": "would pass without",
    "by": "outvoted by",
    "removed": "outvotes",
}


def _ids(before: str, ids: Sequence[str]) -> str:
    if not ids:
        return ""
    more = f" and {len(ids) - SHOWN} more" if len(ids) > SHOWN else ""
    return f"{before}{', '.join(ids[:SHOWN])}{more}"
