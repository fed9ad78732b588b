"""`slam-backend report RUN`: the page of a finished run."""

from pathlib import Path
from typing import Annotated

import typer


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, as `replay` writes it.")],
    out: Annotated[
        Path | None, typer.Option(metavar="F", help="Default: report.html in the run directory.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(metavar="F", help="TUM, KITTI, EuRoC or csv file, or a bag.")
    ] = None,
    topic: Annotated[
        str, typer.Option(metavar="T", help="Of a bag of truth with several topics of poses.")
    ] = "",
    beside: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RUN", help="Another run to draw beside it: one of `replay --estimator ekf`, say."
        ),
    ] = None,
) -> None:
    """Write report.html: one file, with everything in it, that opens in any browser without a network."""
    from ..lab.report import REPORT, write_report
    from ..lab.report.subject import Subject

    subject = Subject(run, beside={each.name: Subject(each).online for each in beside or ()})
    if truth is not None:
        from ..lab.evaluate import laid_over
        from ..lab.truth import load_truth

        subject.truth = laid_over(subject.trajectory, load_truth(truth, topic))
    target = out or run / REPORT
    write_report(subject, target)
    typer.echo(f"open {target}")
