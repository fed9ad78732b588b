"""`slam-backend dataset NAME`: public data as a bag."""

import json
from pathlib import Path
from typing import Annotated

import typer

from .progress import progress


def command(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Which one; see --list.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="BAG", help="Default: NAME.mcap here.")] = None,
    folder: Annotated[
        Path | None,
        typer.Option("--from", metavar="FOLDER", help="Of a data set that gtsam does not bring: its files."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was made as JSON.")] = False,
    as_list: Annotated[bool, typer.Option("--list", help="List the data sets.")] = False,
) -> None:
    """Write a public data set, shipped with gtsam or from a folder, as a bag: one recording with the topics a robot would publish."""
    from ..lab.datasets import DATASETS, RECORDINGS, make_dataset

    if as_list or name is None:
        lines = {known: made.description for known, made in DATASETS.items()}
        lines |= {known: f"{made.description}; --from FOLDER" for known, made in RECORDINGS.items()}
        typer.echo(json.dumps(lines) if as_json else "\n".join(f"{k:16} {v}" for k, v in lines.items()))
        return
    with progress(name, None) as advance:
        made = make_dataset(name, out or Path(f"{name}.mcap"), advance, folder)
    if as_json:
        typer.echo(json.dumps(made._asdict(), default=str))
    else:
        typer.echo(f"{made.path}: {made.messages} messages over {made.seconds:.0f} s; {made.description}")
