"""`slam-backend evaluate RUN --truth F`: how far a run, or a trajectory file, is from the truth."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from ..lab.evaluate import Errors

GNSS = "gnss"  # the truth of a run that kept fixes back
TRAJECTORIES = ("trajectory", "online", "odometry")  # of a run directory


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, or a trajectory file.")],
    truth: Annotated[
        Path,
        typer.Option(
            metavar="F", help="TUM, KITTI, EuRoC or csv file, or a bag; or `gnss`: the run's own fixes."
        ),
    ],
    topic: Annotated[str, typer.Option(metavar="T", help="Of a bag with several topics of poses.")] = "",
    align: Annotated[
        Literal["none", "origin", "se2", "se3", "sim3"],
        typer.Option(
            help="How the estimate is laid over the truth; se2: in the plane, sim3: with its scale."
        ),
    ] = "se3",
    delta: Annotated[
        float, typer.Option(min=1e-3, help="m of path that relative errors are taken over.")
    ] = 1.0,
    max_difference: Annotated[float, typer.Option(min=0.0, help="s between two poses of one moment.")] = 0.01,
    offset: Annotated[float, typer.Option(help="s to add to the stamps of the truth.")] = 0.0,
    interpolate: Annotated[
        bool,
        typer.Option(help="The denser trajectory at the stamps of the other, instead of its nearest pose."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="All statistics as JSON.")] = False,
) -> None:
    """Absolute and relative pose errors against a truth, by evo (extra `eval`): the numbers of evo_ape and evo_rpe.

    Of a run: of the smoothed trajectory, of what was believed at the time (online), and of odometry alone.
    """
    if str(truth) == GNSS:
        _against_fixes(run, as_json)
        return
    from dataclasses import asdict

    from ..lab.evaluate import How, evaluate
    from ..lab.truth import has_stamps, load_trajectory, load_truth

    files = {name: run / f"{name}.tum" for name in TRAJECTORIES} if run.is_dir() else {run.name: run}
    by_order = not (has_stamps(truth) and all(map(has_stamps, files.values())))
    how = How(align, delta, max_difference, offset, interpolate, by_order)
    known = load_truth(truth, topic)
    found = {name: evaluate(load_trajectory(path), known, how) for name, path in files.items()}
    if as_json:
        typer.echo(
            json.dumps({"truth": str(truth), "how": asdict(how)} | {k: asdict(e) for k, e in found.items()})
        )
        return
    typer.echo(f"{run} against {truth}, {_aligned(align)}; root mean squares")
    for line in _table(found):
        typer.echo(line)


def _against_fixes(run: Path, as_json: bool) -> None:
    from ..lab.fixes import evaluate_fixes

    found = evaluate_fixes(run)
    if as_json:
        typer.echo(json.dumps({"truth": GNSS, **found}))
        return
    typer.echo(f"{run} against its fixes, horizontally; metres")
    rows = [["", "fixes", "rmse", "median", "max"]]
    for name, errors in found.items():
        rows.append(
            [name, f"{errors['count']:.0f}", *(f"{errors[k]:.3f}" for k in ("rmse", "median", "max"))]
        )
    for line in columns(rows):
        typer.echo(line)


def _aligned(align: str) -> str:
    return {"none": "not aligned", "origin": "first poses laid together"}.get(
        align, f"{align.upper()} alignment"
    )


def _table(found: "dict[str, Errors]") -> list[str]:
    """A line for each trajectory."""
    rows = [["", "poses", "ATE m", "ATE deg", "RPE m/m", "RPE deg/m", "ATE max m", "scale"]]
    for name, errors in found.items():
        numbers = [_shown(value) for value in errors.numbers().values()]
        rows.append([name, str(errors.poses), *numbers, _shown(errors.ate["max"]), f"{errors.scale:.6g}"])
    return columns(rows)


def columns(rows: list[list[str]]) -> list[str]:
    """Rows of equally many cells as lines, set right but for the first column."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))]
        )
        for row in rows
    ]


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.6f}"
