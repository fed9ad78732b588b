"""`slam-backend replay INPUT...`: bags, journals and pose graphs through the smoother, into a run directory."""

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ..core.errors import BadConfig, SlamError
from .progress import Progress, progress, silent

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ..core.backend import Update
    from ..io.history import History
    from ..io.replay import Run
    from ..io.result import Result
    from ..io.resultbag import With


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
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="K=A,B,C", help="A run for each value of a setting; may be given several times."
        ),
    ] = None,
    bag: Annotated[
        Literal["link", "copy"] | None,
        typer.Option(
            help="Write run.mcap for Foxglove and RViz: path, map -> odom, landmarks, graph, decisions. "
            "copy: with the inputs in it; link: with links to them beside it."
        ),
    ] = None,
    report: Annotated[
        bool, typer.Option(help="Write report.html, the page that answers what people ask.")
    ] = True,
    rerun: Annotated[
        str | None,
        typer.Option(
            metavar="F", help="Stream to Rerun: a file F.rrd, rerun+http://HOST:PORT/proxy, or spawn."
        ),
    ] = None,
    continued: Annotated[
        Path | None,
        typer.Option(
            "--continue", metavar="RUN", help="Go on in the map of a finished run, with its configuration."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: runs/NAME of the input.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Replay recorded logs through the same core as the live node, and write a run directory.

    Ctrl-C ends the run where it is and saves it, with exit code 130; a second one leaves at once.
    With --sweep a run directory for each combination of the values, and a comparison with the first of them.
    """
    if final == "batch" and estimator != "isam2":
        raise BadConfig("--final batch: a filter has no batch solution; leave it out, or --estimator")
    if sweep and rerun:
        raise BadConfig("--rerun: shows one run; leave it out, or --sweep")
    target = out or Path("runs") / inputs[0].stem
    if continued and target.absolute() == continued.absolute():
        raise BadConfig(f"--out {target}: is the run that is continued; name another directory")
    job = Job(
        tuple(inputs), config, tuple(settings or ()), final, estimator, bag, report, rerun, continued, target
    )
    if sweep:
        _sweep(job, sweep, as_json)
        return
    result = work(job, progress)
    if as_json:
        typer.echo(json.dumps(result.summary))
    else:
        _report(result.run, target)
    if result.run.ended == "interrupted":
        raise typer.Exit(130)


@dataclass(frozen=True)
class Job:
    """What one replay takes, in the words of the command line; plain data, for a process of its own."""

    inputs: tuple[Path, ...]
    config: Path | None
    settings: tuple[str, ...]
    final: Literal["none", "batch"]
    estimator: str
    bag: "With | None"
    report: bool
    rerun: str | None
    continued: Path | None
    out: Path


def work(job: Job, shown: "Progress") -> "Result":
    """Replay, and write the run directory."""
    from ..io.configfile import blaming, load_config
    from ..io.history import History
    from ..io.replay import replay
    from ..io.rundir import prepare
    from ..lab.ekf import ESTIMATORS
    from ..lab.viewer import Viewer
    from .interrupt import interruptible

    prepare(job.out)
    with blaming(job.config):
        config = load_config(job.config) if job.config else None
        run = replay(
            job.inputs, config, job.settings, job.final, ESTIMATORS[job.estimator], continued=job.continued
        )
        history = History(run)
        viewer = Viewer(run, job.rerun) if job.rerun else None
        with interruptible(run.stop):
            watch(run, [history.see, *([viewer.see] if viewer else [])], shown)
    write(run.result, history, job.out, job.report, job.bag)
    if viewer:
        viewer.finish()
    return run.result


def write(result: "Result", history: "History", out: Path, report: bool, bag: "With | None") -> None:
    """All files of a run directory."""
    from ..io.formats import trajectory as forms
    from ..io.formats import write_trajectory
    from ..io.history import NAME
    from ..io.resultbag import write_result_bag
    from ..io.rundir import write_run
    from ..lab.picture import PICTURE, draw
    from ..lab.report import REPORT, write_report
    from ..lab.report.subject import Subject
    from ..lab.unguarded import NAME as UNGUARDED
    from ..lab.unguarded import unguarded

    write_run(result, out)
    history.write(out / NAME)
    draw(result, out / PICTURE)
    if bag:
        write_result_bag(result, out, bag)
    if report:
        if (warped := unguarded(result)) is not None:
            write_trajectory(out / UNGUARDED, forms.Trajectory(warped.stamps, warped.sevens))
        write_report(Subject(out), out / REPORT)


def aside(job: Job) -> str:
    """`work` in a process of its own: what went wrong, in one line."""
    try:
        run = work(job, silent).run
    except (SlamError, OSError) as error:
        return str(error)
    return "interrupted" if run.ended == "interrupted" else ""


def _sweep(job: Job, sweeps: "Sequence[str]", as_json: bool) -> None:
    """All combinations, then those that ended well beside the first of them."""
    from ..io.finished import FinishedRun
    from ..io.rundir import prepare
    from ..lab.compare import compare
    from ..lab.sweep import grid, in_processes
    from .compare import as_plain, show

    points = grid(sweeps)
    jobs = [replace(job, settings=(*job.settings, *point), out=job.out / ",".join(point)) for point in points]
    for each in jobs:
        prepare(each.out)
    with progress("sweep", len(jobs)) as advance:
        failures = in_processes(aside, jobs, lambda: advance(1))
    for each, failure in zip(jobs, failures, strict=True):
        if failure:
            sys.stderr.write(f"failed: {each.out.name}: {failure}\n")
    done = [FinishedRun(each.out) for each, failure in zip(jobs, failures, strict=True) if not failure]
    found = compare(done) if done else []
    if as_json:
        typer.echo(json.dumps([as_plain(each) for each in found]))
    elif found:
        show(found)
    if len(done) < len(jobs):
        raise typer.Exit(2)


def watch(run: "Run", watchers: "Sequence[Callable[[Update], None]]", shown: "Progress") -> None:
    with shown("replay", run.inputs.count) as advance:
        told = 0
        for update in run:
            for see in watchers:
                see(update)
            advance(run.inputs.read - told)
            told = run.inputs.read
        advance(run.inputs.count - told)


def _report(run: "Run", target: Path) -> None:
    """What people want to know first; trouble on stderr."""
    summary = run.result.summary
    counts, cost, timing = summary["counts"], summary["cost"], summary["timing"]
    for note in run.notes:
        sys.stderr.write(f"note: {note}\n")
    for line in summary["damage"]:
        sys.stderr.write(f"damage: {line}\n")
    refused = {
        rule: n
        for rule, n in summary["decisions"].items()
        if rule not in ("admit/unjudged", "settle/late", "doubt/expected")
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
    if (earth := summary["earth"]) is not None:
        typer.echo(_earth(earth))
    typer.echo(f"look at {target / 'trajectory.png'}; run hash {summary['run_hash'][:16]}")


def _earth(told: "Mapping[str, Any]") -> str:
    """How the map lies on the earth, how far the fixes are from it, and whether their noise is what they say."""
    fixes = f"{told['fixes']['told']} fixes"
    if told["map_T_earth"] is None:
        return f"on the earth: unknown ({fixes}): {told['why']}"
    line = f"on the earth: the map's x axis points {told['yaw']:.3f} rad from east; {fixes}"
    for use, away in told["away"].items():
        if away["horizontal"] is not None:
            line += f", {use} {away['horizontal']:.2f} m away horizontally (rms)"
    for source, nis in told["nis"].items():
        if not nis["low"] <= nis["mean"] <= nis["high"]:
            line += (
                f"; '{source}' is {nis['noise_is']:.2g} times as far from what is expected as the noise says"
            )
    return line
