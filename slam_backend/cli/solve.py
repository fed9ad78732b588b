"""`slam-backend solve GRAPH`: the optimum of a pose graph, from a bad start, fast, and what was done."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from .progress import progress

if TYPE_CHECKING:
    from ..io.formats.posegraph import Convention, PoseGraph
    from ..io.optimum import Optimum
    from ..io.problem import Problem

MOST = 10  # names in one line


def command(
    graph: Annotated[Path, typer.Argument(metavar="GRAPH", help="g2o, TORO or PyFG; told by its content.")],
    method: Annotated[
        Literal["lm", "gn", "dogleg", "isam2"],
        typer.Option(help="Levenberg-Marquardt, Gauss-Newton, Dogleg; isam2: vertex by vertex, as if live."),
    ] = "lm",
    robust: Annotated[
        Literal["none", "huber", "cauchy", "tukey", "geman_mcclure", "dcs", "gnc"],
        typer.Option(
            help="A kernel around every edge that is not between consecutive vertices; gnc: refuse the wrong ones among them."
        ),
    ] = "none",
    init: Annotated[
        Literal["auto", "file", "odometry", "chordal"],
        typer.Option(
            help="The start. auto: the file's vertices or the odometry, unless drift has wound them around; then chordal."
        ),
    ] = "auto",
    ordering: Annotated[Literal["colamd", "metis"], typer.Option(help="Of the elimination.")] = "colamd",
    rotation_information: Annotated[
        Literal["gtsam", "g2o"],
        typer.Option(
            help="What 3-D rotation information in a g2o file means; costs differ accordingly. gtsam: of the rotation "
            "vector, in radians; g2o: of the quaternion's vector part, so that the same numbers weigh a fourth."
        ),
    ] = "gtsam",
    polish: Annotated[
        bool, typer.Option("--polish", help="Go on until the largest step is below 1e-9 m and rad.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="F",
            help="The solved graph (.g2o .graph .toro .pyfg) or its trajectory (.tum .txt .kitti .euroc .csv).",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was done as JSON.")] = False,
) -> None:
    """Find the optimum of a pose graph. Costs are chi2/2, gauge priors left out."""
    from ..core.errors import BadFile
    from ..io.formats import read_graph
    from ..io.optimum import Request, optimum
    from ..io.problem import problem_of

    write = _writer(out)
    pose_graph = read_graph(graph, rotation_information)
    if not len(pose_graph.edges):
        raise BadFile(f"{graph}: holds no edges between poses: nothing to optimize")
    if init == "file" and pose_graph.states is None:
        raise BadFile(f"{graph}: states no vertices: there is no --init file in it")
    kernel = "none" if robust == "gnc" else robust
    problem = problem_of(pose_graph, kernel)
    request = Request(method, robust == "gnc", kernel, init, ordering, polish)
    with progress(
        *(("vertices", len(pose_graph.ids)) if method == "isam2" else ("iterations", None))
    ) as advance:
        found = optimum(problem, request, advance)
    said = {"graph": str(graph), "method": method, "robust": robust, **_said(problem, found)}
    said["convention"] = _convention(graph, pose_graph.space, rotation_information)
    said["out"] = None if out is None else str(out)
    said["not_written"] = write(problem.solved(found.solution.values), rotation_information)
    typer.echo(json.dumps(said) if as_json else "\n  ".join(_lines(said)))


def _said(problem: "Problem", found: "Optimum") -> dict[str, Any]:
    """Everything that there is to say, for `--json`; `_lines` says it to people."""
    solution, updates = found.solution, len(problem.graph.ids)
    return {
        "vertices": len(problem.graph.ids),
        "edges": len(problem.graph.edges),
        "cost_initial": found.cost_initial,
        "cost_start": found.cost_start,
        "cost": solution.cost,
        "iterations": updates if found.start.name == "isam2" else len(found.steps),
        "seconds": round(found.seconds, 4),
        "initialization": found.start.name,
        "why": found.start.why,
        "stop": solution.stop,
        "gauges": [problem.name(key) for key in solution.gauged],
        "parts": solution.found.sizes(),
        "unconnected": [problem.name(key) for key in solution.found.idle],
        "refused": [[problem.name(key) for key in factor.keys] for factor in found.refused],
        "decisions": [
            f"{decision.id}: {decision.detail or decision.reason}" for decision in problem.decisions
        ],
        "left_out": [*problem.left_out, *found.left_out],
        "notes": [*problem.graph.notes, *solution.notes],
        "steps": [{**step._asdict(), "seconds": round(seconds, 4)} for step, seconds in found.steps],
    }


def _lines(said: dict[str, Any]) -> list[str]:
    """One line with the numbers; one more for each thing that is not as usual."""
    counted = f"{said['iterations']} {'updates' if said['method'] == 'isam2' else 'iterations'}"
    lines = [
        f"{said['graph']}: {said['vertices']} vertices, {said['edges']} edges; cost {said['cost_initial']:.7g} -> "
        f"{said['cost']:.7g} ({said['convention']}) after {counted} of {said['method']}, {said['seconds']:.2f} s: {said['stop']}",
        f"start: {said['initialization']}, cost {said['cost_start']:.7g}: {said['why'] or 'as asked for'}",
    ]
    if len(said["parts"]) > 1:
        held = f", each held at its first vertex: {_some(said['gauges'])}" if said["gauges"] else ""
        lines.append(f"{len(said['parts'])} parts that nothing connects{held}")
    named = (
        ("unconnected", "no edge touches them"),
        ("decisions", "refused by the firewall"),
        ("left_out", "not used"),
        ("not_written", "not in the written file"),
    )
    if said["out"]:
        lines.append(f"written: {said['out']}")
    lines += [f"{what}: {_some(said[key])}" for key, what in named if said[key]]
    if said["robust"] == "gnc":
        lines.append(f"wrong loops: {_some(['-'.join(ends) for ends in said['refused']]) or 'none'}")
    return [*lines, *said["notes"]]


def _some(names: list[str]) -> str:
    more = f" and {len(names) - MOST} more" if len(names) > MOST else ""
    return ", ".join(names[:MOST]) + more


def _convention(path: Path, space: str, rotation_information: str) -> str:
    from ..io.formats import format_of

    meant = f", rotation information as {rotation_information} means it"
    return "chi2/2" + (meant if space == "3d" and format_of(path).name == "g2o" else "")


def _writer(out: Path | None) -> "Callable[[PoseGraph, Convention], list[str]]":
    """How to write what was asked for; a name that says nothing is refused before any work is done."""
    from ..core.errors import BadFile
    from ..io.formats import FORMATS, write_graph, write_trajectory
    from ..io.formats.trajectory import Trajectory

    if out is None:
        return lambda _, __: []
    kinds = {form.kind for form in FORMATS if out.name.lower().endswith(form.extensions)}
    if not kinds:
        known = ", ".join(end for form in FORMATS for end in form.extensions)
        raise BadFile(f"{out}: cannot tell what to write from its name: end it in {known}")

    def write(graph: "PoseGraph", convention: "Convention") -> list[str]:
        if "graph" in kinds:
            return list(write_graph(out, graph, convention))
        assert graph.poses is not None
        stamps = graph.stamps_at() if graph.stamps is None else graph.stamps
        return list(write_trajectory(out, Trajectory(stamps, graph.poses)))

    return write
