"""`slam-backend replay INPUT...`: bags, journals and pose graphs through the smoother, into a run directory."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ..core.errors import BadConfig
from .progress import progress

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..core.backend import Update
    from ..io.replay import Run


def command(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="INPUT...", help="Bags (rosbag1, rosbag2 folder, .db3, .mcap), or one pose graph."
        ),
    ],
    config: Annotated[
        Path | None,
        typer.Option(metavar="F", help="YAML. Without it, sources are found by the types of the topics."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="K=V", help="One setting, such as keyframes.distance=1.0"),
    ] = None,
    final: Annotated[
        Literal["none", "batch"], typer.Option(help="batch: end at the optimum of the kept factors.")
    ] = "none",
    estimator: Annotated[
        Literal["isam2", "ekf"],
        typer.Option(help="isam2: the smoother; ekf: a filter over the same factors, to compare with."),
    ] = "isam2",
    report: Annotated[
        bool, typer.Option(help="Write report.html, the page that answers what people ask.")
    ] = True,
    rerun: Annotated[
        str | None,
        typer.Option(
            metavar="F", help="Stream to Rerun: a file F.rrd, rerun+http://HOST:PORT/proxy, or spawn."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: runs/NAME of the input.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Replay recorded logs through the same core as the live node, and write a run directory."""
    from ..io.configfile import load_config
    from ..io.history import NAME, History
    from ..io.replay import replay
    from ..io.rundir import prepare, write_run
    from ..lab.ekf import ESTIMATORS
    from ..lab.picture import PICTURE, draw
    from ..lab.report import REPORT, write_report
    from ..lab.report.subject import Subject
    from ..lab.viewer import Viewer

    if final == "batch" and estimator != "isam2":
        raise BadConfig("--final batch: a filter has no batch solution; leave it out, or --estimator")
    target = out or Path("runs") / inputs[0].stem
    prepare(target)
    run = replay(
        inputs, load_config(config) if config else None, settings or (), final, ESTIMATORS[estimator]
    )
    history = History(run)
    viewer = Viewer(run, rerun) if rerun else None
    _watch(run, [history.see, *([viewer.see] if viewer else [])])
    write_run(run.result, target)
    history.write(target / NAME)
    draw(run.result, target / PICTURE)
    if viewer:
        viewer.finish()
    if report:
        write_report(Subject(target), target / REPORT)
    if as_json:
        typer.echo(json.dumps(run.result.summary))
    else:
        _report(run, target)


def _watch(run: "Run", watchers: "Sequence[Callable[[Update], None]]") -> None:
    with progress("replay", run.inputs.count) as advance:
        shown = 0
        for update in run:
            for see in watchers:
                see(update)
            advance(run.inputs.read - shown)
            shown = run.inputs.read
        advance(run.inputs.count - shown)


def _report(run: "Run", target: Path) -> None:
    """What people want to know first; trouble on stderr."""
    summary = run.result.summary
    counts, cost, timing = summary["counts"], summary["cost"], summary["timing"]
    for note in run.notes:
        sys.stderr.write(f"note: {note}\n")
    for line in summary["damage"]:
        sys.stderr.write(f"damage: {line}\n")
    refused = {
        rule: n for rule, n in summary["decisions"].items() if rule not in ("admit/unjudged", "settle/late")
    }
    for rule, n in refused.items():
        example = next(d for d in run.decisions if f"{d.stage}/{d.reason}" == rule)
        sys.stderr.write(f"{example.verdict}: {n} x {rule}: {example.detail} ({example.id})\n")
    loops = (
        f", {counts['loops_accepted']} of {counts['loops_offered']} loops" if counts["loops_offered"] else ""
    )
    landmarks = f", {counts['landmarks']} landmarks" if counts["landmarks"] else ""
    typer.echo(
        f"{target}: {counts['keyframes']} keyframes{landmarks}{loops}; cost {cost['initial']:.6g} by odometry alone, "
        f"{cost['online']:.6g} online, {cost['final']:.6g} at the end; {timing['wall_s']:.1f} s "
        f"(update p50 {timing['update_ms']['p50']:.1f} ms, p99 {timing['update_ms']['p99']:.1f} ms)"
    )
    typer.echo(f"look at {target / 'trajectory.png'}; run hash {summary['run_hash'][:16]}")
