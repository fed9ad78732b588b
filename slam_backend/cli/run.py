"""`slam-backend run`: the ROS 2 node, on a ROS install or with the wheels of the extra `ros`."""

import sys
from pathlib import Path
from typing import Annotated

import typer


def command(
    config: Annotated[
        Path | None,
        typer.Option(metavar="F", help="The YAML that replay takes. Without it, topics are found by type."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="K=V", help="One setting, such as keyframes.distance=1.0"),
    ] = None,
    namespace: Annotated[
        str, typer.Option(metavar="N", help="Of the node; it is named slam_backend in it.")
    ] = "",
    data_dir: Annotated[str, typer.Option(metavar="DIR", help="For the journal and saved runs.")] = "",
    ros_arguments: Annotated[
        list[str] | None, typer.Argument(metavar="[-- ROS ARGS]", help="Such as: -- -p use_sim_time:=true")
    ] = None,
) -> None:
    """Run the lifecycle node until Ctrl-C; the run is saved at the end."""
    from ..core.config import Config
    from ..core.errors import MissingExtra
    from ..io.configfile import configured, load_config
    from ..ros.signals import wishes

    chosen = configured(load_config(config) if config else Config(), settings or ())
    if data_dir:
        chosen = chosen.model_copy(update={"data_dir": data_dir})
    heard = wishes()
    try:
        from ..ros.process import main
    except ImportError as error:
        raise MissingExtra(
            f"{error.name or error} is not installed: source a ROS 2 Jazzy install, or pip install 'slam_backend[ros]'"
        ) from None
    given = [each for each in ros_arguments or [] if each != "--ros-args"]
    remap = ["-r", f"__ns:=/{namespace.strip('/')}"] if namespace else []
    code = main(["--ros-args", *remap, *given], chosen, heard)
    sys.stdout.flush()
    raise typer.Exit(code)
