"""`slam-backend convert IN OUT`: pose graphs and trajectories from one format to another."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer


def command(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Told by its content.")],
    target: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="Told by its extension. Graphs: .g2o .graph .toro .pyfg; trajectories: .tum .txt .kitti .euroc .csv",
        ),
    ],
    rotation_information: Annotated[
        Literal["gtsam", "g2o"],
        typer.Option(
            help="What 3-D rotation information in g2o files means. gtsam: of the rotation vector, in radians; "
            "g2o: of the quaternion's vector part, half of that, so that the same numbers weigh a fourth."
        ),
    ] = "gtsam",
    as_json: Annotated[bool, typer.Option("--json", help="Print what was done as JSON.")] = False,
) -> None:
    """Convert a pose graph or a trajectory, and say what the new format cannot hold."""
    from ..io.formats import convert

    done = convert(source, target, rotation_information=rotation_information)
    typer.echo(json.dumps({"source": str(source), "target": str(target), "done": done}) if as_json else done)
