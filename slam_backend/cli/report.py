"""`slam-backend report RUN`: the page of a finished run."""

from pathlib import Path
from typing import Annotated

import typer


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, as `replay` writes it.")],
    out: Annotated[
        Path | None, typer.Option(metavar="F", help="Default: report.html in the run directory.")
    ] = None,
) -> None:
    """Write report.html: one file, with everything in it, that opens in any browser without a network."""
    from ..io.rundir import FinishedRun
    from ..lab.report import REPORT, write_report

    target = out or run / REPORT
    write_report(FinishedRun(run), target)
    typer.echo(f"open {target}")
