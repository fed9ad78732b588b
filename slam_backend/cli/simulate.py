"""`slam-backend simulate SCENARIO --out BAG`: a drive through a world whose truth is known."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from ..lab.options import Options


def command(
    scenario: Annotated[
        str | None, typer.Argument(metavar="SCENARIO", help="Which world; see --list.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="BAG", help="Default: SCENARIO.mcap here.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same bag.")] = 0,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="An option of the drive; see --list."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was made as JSON.")] = False,
    as_list: Annotated[
        bool, typer.Option("--list", help="List the worlds, and the options with defaults.")
    ] = False,
) -> None:
    """Simulate a drive: a bag of what the sensors said; beside it the truth as TUM and the configuration to replay."""
    from ..lab.simulate import simulate, write_simulation

    if as_list or scenario is None:
        _list(as_json)
        return
    made = simulate(scenario, seed, _options(settings or []))
    written = write_simulation(made, out or Path(f"{scenario}.mcap"))
    if as_json:
        paths = {name: path and str(path) for name, path in written._asdict().items()}
        counts = {"messages": len(made.sent), "loops": len(made.loops), "lost": dict(made.lost)}
        typer.echo(json.dumps({"scenario": scenario, "seed": seed, **paths, **counts}))
        return
    lost = "".join(f", {count} {what}" for what, count in made.lost.items())
    typer.echo(
        f"{written.bag}: {len(made.sent)} messages, {len(made.loops)} loops{lost}; truth in {written.truth}"
    )
    typer.echo(f"slam-backend replay {written.bag} --config {written.config}")


def _options(settings: list[str]) -> "Options":
    """`poses=2000` and the like to Options; BadConfig names what is wrong and what there is."""
    from dataclasses import fields
    from difflib import get_close_matches

    from ..core.errors import BadConfig
    from ..lab.options import Options

    known: dict[str, Any] = {field.name: type(field.default) for field in fields(Options)}
    known["landmarks"] = int  # its default is None: what the world has
    values: dict[str, float | str] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if name not in known:
            near = get_close_matches(name, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
            raise BadConfig(f"--set {setting}: there is no option '{name}'; {hint}")
        try:
            values[name] = known[name](text)
        except ValueError:
            kind = "whole number" if known[name] is int else "number"
            raise BadConfig(
                f"--set {setting}: {name} needs a {kind}, as in {name}=2{'' if equals else ' with ='}"
            ) from None
    return Options(**values)  # type: ignore[arg-type]  # checked by name above


def _list(as_json: bool) -> None:
    from dataclasses import asdict

    from ..lab.options import Options
    from ..lab.simulate import SCENARIOS

    worlds = {name: world.description for name, world in SCENARIOS.items()}
    options = asdict(Options())
    if as_json:
        typer.echo(json.dumps({"scenarios": worlds, "options": options}))
        return
    typer.echo("\n".join(f"{name:28} {line}" for name, line in worlds.items()))
    typer.echo("\noptions and their defaults (--set NAME=VALUE):")
    typer.echo(
        "\n".join(
            f"{name:28} {'of the world' if value is None else value}" for name, value in options.items()
        )
    )
