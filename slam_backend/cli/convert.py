"""`slam-backend convert IN OUT`: pose graphs, trajectories and finished runs from one format to another."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer


def command(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Told by its content; or a run directory.")],
    target: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="Told by its extension. Graphs: .g2o .graph .toro .pyfg; trajectories: .tum .txt .kitti .euroc .csv; "
            "of a run also .ply, .geojson and .kml",
        ),
    ],
    rotation_information: Annotated[
        Literal["gtsam", "g2o"],
        typer.Option(
            help="What 3-D rotation information in g2o files means. gtsam: of the rotation vector, in radians; "
            "g2o: of the quaternion's vector part, half of that, so that the same numbers weigh a fourth."
        ),
    ] = "gtsam",
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON[,ALT[,YAW]]",
            help="For .geojson and .kml: where the map's origin lies (degrees, m), and its x axis, degrees from east to north; "
            "without it, as the run's GNSS fixes have shown.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was done as JSON.")] = False,
) -> None:
    """Convert a pose graph, a trajectory or a finished run, and say what the new format cannot hold."""
    if source.is_dir():
        from ..io.finished import FinishedRun
        from ..io.maps import export, origin_of

        done = export(FinishedRun(source), target, origin_of(origin) if origin else None)
    else:
        from ..io.formats import convert

        done = convert(source, target, rotation_information=rotation_information)
    typer.echo(json.dumps({"source": str(source), "target": str(target), "done": done}) if as_json else done)
